import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.geometry import look_at
from advnerf_core.scene.colour import IDENTITY, ColourMap
from advnerf_core.scene.field import load_scene
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.scene_file import save_splat_scene
from nodes.cli import main as cli
from nodes.lab.importing.colours import match_colours
from nodes.lab.importing.errors import ImportRecordingError
from tests.support.opaque_scene import CAMERA, INSIDE, write_frames, write_scene
from tests.support.splats import room

TRUE = ColourMap(((0.85, 0.1, 0.0), (0.05, 0.9, 0.0), (0.0, 0.1, 0.7)), (0.03, 0.0, 0.05), 1.2)


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scene.safetensors")


def frames_of(scene, folder, poses):
    return write_frames(scene, folder / "transforms_car.json", poses, TRUE)


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


def test_frames_of_another_world_get_no_map(tmp_path, scene):
    images = frames_of(scene, tmp_path, INSIDE)
    elsewhere = [look_at([0.7 - 0.1 * k, -0.6, 0.5], [-1.0, 1.0, 0.2 * k]) for k in range(5)]
    write_transforms(images, [f"{k}.png" for k in range(5)], np.stack(elsewhere), CAMERA)
    output = tmp_path / "mapped.safetensors"
    told = (
        r"expected frames of what .*scene\.safetensors shows, from the same places, got a PSNR of \d+\.\d dB"
    )
    with pytest.raises(ImportRecordingError, match=told):
        match_colours(scene, images, output, 4)
    assert not output.exists()


def test_frames_may_differ_in_size(tmp_path, scene):
    cameras = [CAMERA, CAMERA.resized(80, 60), CAMERA]
    images = write_frames(scene, tmp_path / "transforms_car.json", INSIDE[:3], TRUE, cameras)
    match = match_colours(scene, images, scene, 4)
    assert match.frames == 3
    assert match.after_db > 50.0


def test_a_splat_has_no_colour_map(tmp_path, scene):
    images = frames_of(scene, tmp_path, INSIDE[:1])
    splat = tmp_path / "splat.safetensors"
    save_splat_scene(splat, SplatRenderer(room(60), box=((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))))
    with pytest.raises(ImportRecordingError, match=r"expected a scene that was learned, got the splat"):
        match_colours(splat, images, splat, 4)
