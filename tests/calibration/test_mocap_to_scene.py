"""A scene of known scale and frame is placed again; lines, strangers and bent reconstructions are refused with the reason."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import camera_mount, invert_transform, make_transform, planar_pose
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.measured import SceneCalibration
from calibration.mocap_to_scene import place_scene
from calibration.schema import load_calibration, save_calibration
from tests.support.boards import turned

SCALE = 0.37
T_WORLD_FROM_SCENE = make_transform(
    Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), [1.0, -2.0, 0.5]
)


def cameras(rng, count=40, noise=(0.003, 0.002), straight=False):
    """The same cameras in the world and in a scene ``world = SCALE R scene + t``."""
    mount = camera_mount(0.3, 0.0, 0.2, 0.17)
    scene, world = {}, {}
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        pose = (
            planar_pose(0.05 * k, 0.0, 0.0)
            if straight
            else planar_pose(2.0 * np.cos(angle), 1.5 * np.sin(angle), angle)
        )
        name = f"{k:03d}.png"
        world[name] = pose @ mount
        inside = invert_transform(T_WORLD_FROM_SCENE) @ turned(world[name], rng, noise[1], noise[0])
        inside[:3, 3] /= SCALE
        scene[name] = inside
    return scene, world


def test_scale_and_frame_come_back_in_spite_of_wrong_poses():
    rng = np.random.default_rng(0)
    scene, world = cameras(rng)
    for name in ("005.png", "019.png", "020.png"):
        scene[name] = turned(scene[name], rng, 0.5, 1.0)
    fit = place_scene(scene, world)
    found = fit.calibration
    assert found.scale == pytest.approx(SCALE, rel=2e-3)
    np.testing.assert_allclose(found.similarity.T_target_from_source, T_WORLD_FROM_SCENE, atol=5e-3)
    assert found.residuals["outliers"] == 3.0
    # Three axes of 3 mm each; what was left out is placed hardly worse than what was fitted.
    assert found.residuals["rms_position_m"] == pytest.approx(0.003 * np.sqrt(3.0), rel=0.3)
    assert np.median(fit.held_out_m) < 0.008


def test_a_straight_drive_is_refused():
    with pytest.raises(DegenerateDataError, match="on one line"):
        place_scene(*cameras(np.random.default_rng(1), straight=True))


def test_too_few_shared_names_are_refused():
    scene, world = cameras(np.random.default_rng(2))
    with pytest.raises(
        DegenerateDataError,
        match=r"at least 12 cameras with a pose in both worlds, got 5: .* same file names",
    ):
        place_scene({name: scene[name] for name in list(scene)[:5]}, world)


def test_another_room_is_refused():
    rng = np.random.default_rng(3)
    scene, world = cameras(rng)
    shuffled = dict(zip(scene, [scene[name] for name in rng.permutation(list(scene))], strict=True))
    with pytest.raises(PoorFitError, match="cameras to agree"):
        place_scene(shuffled, world)


def test_the_file_survives_a_round_trip(tmp_path):
    found = place_scene(*cameras(np.random.default_rng(4))).calibration
    save_calibration(found, tmp_path / "scene.yaml")
    assert load_calibration(SceneCalibration, tmp_path / "scene.yaml") == found
