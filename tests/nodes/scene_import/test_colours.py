import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.scene.colour import IDENTITY, ColourMap
from advnerf_core.scene.field import SceneField, SceneFieldConfig, load_scene, save_scene
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.scene_file import save_splat_scene
from nodes.cli import main as cli
from nodes.lab.importing.colours import match_colours
from nodes.lab.importing.errors import ImportRecordingError
from tests.support.splats import room

CAMERA = Pinhole(40, 30, 30.0, 30.0, 20.0, 15.0)
TRUE = ColourMap(((0.85, 0.1, 0.0), (0.05, 0.9, 0.0), (0.0, 0.1, 0.7)), (0.03, 0.0, 0.05), 1.2)


@pytest.fixture
def scene(tmp_path):
    """A scene file of opaque, colourful matter."""
    grid = HashGridConfig(levels=4, features=2, log2_entries=10, coarsest=4, finest=16)
    field = SceneField(SceneFieldConfig((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), grid=grid, hidden=8, features=7))
    with torch.no_grad():
        field.grid.table.normal_(std=0.8, generator=torch.Generator().manual_seed(0))
        field.density_2.bias[0] = 6.0
        field.colour_2.weight.normal_(std=1.5, generator=torch.Generator().manual_seed(1))
    path = tmp_path / "scene.safetensors"
    save_scene(path, field, np.ones((16, 16, 16), np.bool_), {"steps": 3})
    return path


def frames_of(scene, folder, poses, colours=TRUE):
    """Pictures that a camera with other colours would take in the scene."""
    renderer, names = FieldRenderer.from_file(scene), []
    for index, pose in enumerate(poses):
        rgb = colours.apply(renderer.render(pose[None], CAMERA)[0][0].numpy())
        names.append(f"{index}.png")
        cv2.imwrite(str(folder / names[-1]), np.rint(255 * rgb[..., ::-1]).astype(np.uint8))
    write_transforms(
        folder / "transforms_car.json", names, np.stack(poses), CAMERA, camera_ids=["car"] * len(names)
    )
    return folder / "transforms_car.json"


INSIDE = [look_at([0.3 * np.cos(a), 0.3 * np.sin(a), 0.1], [0.0, 0.0, 0.0]) for a in np.linspace(0.0, 5.0, 5)]


def test_the_map_of_the_driving_camera_is_found_and_stored_with_the_scene(tmp_path, scene):
    images = frames_of(scene, tmp_path, INSIDE)
    before = load_scene(scene)[2]["scene_hash"]
    result = CliRunner().invoke(
        cli.app, ["scene", "match-colours", str(scene), str(images), "--most", "4"], catch_exceptions=False
    )
    assert result.exit_code == 0
    assert "colour map fitted to 4 frames" in result.output
    metadata = load_scene(scene)[2]
    assert metadata["scene_hash"] == before, "the scene itself is as it was"
    assert metadata["steps"] == 3
    found = ColourMap.from_dict(metadata["colour_map"])
    rendered = FieldRenderer.from_file(scene, IDENTITY).render(INSIDE[0][None], CAMERA)[0].numpy()
    np.testing.assert_allclose(found.apply(rendered), TRUE.apply(rendered), atol=0.01)
    again = match_colours(scene, images, tmp_path / "other.safetensors", 4)
    assert again.map == found, "a map that is there already is not mapped again"
    assert again.after_db > again.before_db + 10.0


def test_frames_that_look_past_the_scene_are_refused(tmp_path, scene):
    images = frames_of(scene, tmp_path, [look_at([5.0, 5.0 + k, 0.0], [9.0, 9.0, 0.0]) for k in range(2)])
    with pytest.raises(ImportRecordingError, match=r"look into the scene of .*got 0\.0 % of their pixels"):
        match_colours(scene, images, scene, 4)


def test_a_splat_has_no_colour_map(tmp_path, scene):
    images = frames_of(scene, tmp_path, INSIDE[:1])
    splat = tmp_path / "splat.safetensors"
    save_splat_scene(splat, SplatRenderer(room(60), box=((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))))
    with pytest.raises(ImportRecordingError, match=r"expected a scene that was learned, got the splat"):
        match_colours(splat, images, splat, 4)
