"""Attacks on meshes at the junction, over the frames of a scene in closed form."""

import shutil

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.geometry import planar_pose
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
from advnerf_core.objects.mesh.glb import read_glb
from advnerf_core.objects.mesh.shape import ShapeLimits
from advnerf_core.report.clips import read_clip
from nodes.experiment.junction import mesh_cells
from nodes.experiment.junction.cells import CellError
from nodes.experiment.junction.mesh_cells import MeshExperiment
from nodes.experiment.junction.meshes import MeshSettings, mesh_cell, mesh_objects
from nodes.experiment.junction.policy import victim_file
from nodes.experiment.request.frames import DeployedFrames


@pytest.fixture(scope="module", autouse=True)
def mitsuba_works():
    try:
        engine()
    except MeshEngineError as error:
        pytest.skip(str(error))


def quiet(fraction, text=""):
    pass


def test_deployed_frames_are_what_the_policy_sees_with_depth(trained, wall):
    frames = DeployedFrames(wall, trained.view)
    pose = planar_pose(-24.0, -1.75, 0.1) @ wall.T_car_from_camera
    rgb, depth_m = frames(pose[None], trained.view.pinhole)
    image, depth = wall.observe_at(-24.0, -1.75, 0.1)
    np.testing.assert_array_equal(np.round(255 * rgb[0]).astype(np.uint8), trained.view.image(image))
    # Depth is that of a ray of the policy's own camera, up to the pixels of the finer image.
    mean = cv2.resize(depth[trained.view.window], (200, 66), interpolation=cv2.INTER_AREA)
    flat = np.abs(depth_m[0] / mean - 1.0) < 0.05
    assert flat.mean() > 0.9
    with pytest.raises(ValueError, match="policy's view"):
        frames(pose[None], wall.camera_pinhole)


@pytest.mark.parametrize("target", ["texture", "shape"])
def test_a_cell_of_a_mesh_is_searched_driven_kept_and_not_done_again(target, trained, wall, tmp_path):
    settings = MeshSettings(target, texels=8, ball_m=0.5, limits=ShapeLimits(0.3, samples=1))
    cell = mesh_cell(trained, "straight", "hardened", "gradient", 0, tmp_path, quiet, settings, wall)
    assert cell["extra"]["evaluations"] == trained.config.attack.evaluations
    assert len(cell["surrogate"]["total_cte_m"]) == len(cell["deployed"]["none_total_cte_m"]) == 1
    assert all(np.isfinite(cell[where][key]).all() for where in ("surrogate", "deployed")
               for key in ("total_cte_m", "none_total_cte_m"))  # fmt: skip
    found = sorted(tmp_path.glob("*.glb"))
    assert len(found) == len(trained.world.objects)
    again = read_glb(found[0])
    plain = mesh_objects(trained, settings)[0].mesh
    assert len(again.vertices) == len(plain.vertices)
    moved = np.abs(np.sort(again.vertices, axis=0) - np.sort(plain.vertices, axis=0)).max()
    assert (moved < 1e-6) == (target == "texture")
    assert not list(tmp_path.glob("*.state.safetensors"))
    torch.manual_seed(1)
    assert mesh_cell(trained, "straight", "hardened", "gradient", 0, tmp_path, quiet, settings, None) == cell
    # A campaign's cell takes what is there, and films a drive past the exported objects.
    settings_of = MeshExperiment(trained.config, trained.file, trained.folder, trained.setting, settings)
    filmed = mesh_cells.run_cell(settings_of, "straight", "hardened", "gradient", 0, tmp_path, quiet)
    assert filmed == {**cell, "extra": {**cell["extra"], "clip": f"{tmp_path.name}/clip.mp4"}}
    film = read_clip(tmp_path / "clip.mp4")
    assert len(film) == trained.config.horizon + 1
    again = mesh_cells.run_cell(settings_of, "straight", "hardened", "none", 0, tmp_path / "plain", quiet)
    assert not np.array_equal(read_clip(tmp_path / again["extra"]["clip"])[0], film[0])


def test_no_attack_is_one_everywhere_and_wrong_names_are_told(trained, wall, tmp_path):
    cell = mesh_cell(trained, "right", "naive", "none", 0, tmp_path, quiet, MeshSettings(texels=8), wall)
    for where in ("surrogate", "deployed"):
        assert cell[where]["total_cte_m"] == cell[where]["none_total_cte_m"]
    # Another victim under the same name: what is there is not taken for its result.
    weights = victim_file(trained, "naive").read_bytes()
    try:
        shutil.copy(victim_file(trained, "hardened"), victim_file(trained, "naive"))
        anew = mesh_cell(trained, "right", "naive", "none", 0, tmp_path, quiet, MeshSettings(texels=8), wall)
    finally:
        victim_file(trained, "naive").write_bytes(weights)
    assert anew["settings_hash"] != cell["settings_hash"]
    with pytest.raises(CellError, match="scenario of straight, right, left"):
        mesh_cell(trained, "up", "naive", "none", 0, tmp_path, quiet)
    with pytest.raises(CellError, match="method of none, random, gradient"):
        mesh_cell(trained, "left", "naive", "cem", 0, tmp_path, quiet, MeshSettings("shape"))
