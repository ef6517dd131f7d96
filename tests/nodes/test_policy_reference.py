from pathlib import Path

import numpy as np
import pytest

from advnerf_core.driving.expert import Expert
from advnerf_core.driving.frames import Frames, FrameStore
from advnerf_core.driving.policy_view import PolicyView
from advnerf_core.geometry import Pinhole, planar_pose
from calibration.schema import CameraCalibration, RoomCalibration, load_calibration
from nodes.policy_reference import from_bag, from_run, from_twin
from nodes.runtime.bag import BagWriter
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import encode, image_message, pose_message

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
ROOM = TWIN / "room.yaml"
VIEW = PolicyView(load_calibration(CameraCalibration, TWIN / "camera.yaml").pinhole)
T0, MS = 1_800_000_000_000_000_000, 1_000_000


def write_bag(folder, poses, size=(188, 336)):
    """Poses at 50 Hz, an image of its own grey at every fifth, 7 ms after it."""
    with BagWriter(folder) as writer:
        for i, pose in enumerate(poses):
            t = T0 + i * 20 * MS
            writer.write("/vicon/car", encode(pose_message(planar_pose(*pose), t)), t, t, i)
            if i % 5 == 0:
                image = np.full((*size, 3), i, np.uint8)
                stamp = t + 7 * MS
                writer.write("/camera/image_raw", encode(image_message(image, stamp, "camera")), stamp, stamp, i // 5)
    return folder


def test_frames_of_a_bag_are_labelled_by_the_expert_at_their_own_stamps(tmp_path):
    expert = Expert(load_calibration(RoomCalibration, ROOM).reference_path)
    poses = expert.path.pose_at(0.02 * 0.8 * np.arange(200)) + np.array([0.0, 0.1, 0.05])
    reference = from_bag(write_bag(tmp_path / "bag", poses), ROOM, VIEW, count=20)
    numbers = reference.images[:, 0, 0, 0].astype(int)
    assert len(numbers) == 20
    assert numbers[0] == 0
    assert (np.diff(numbers) > 0).all()
    between = poses[numbers] + 7 / 20 * (poses[numbers + 1] - poses[numbers])
    np.testing.assert_allclose(reference.steering_rad, expert.steer_states(between), atol=1e-4)


def test_a_bag_that_is_of_no_use_is_one_error(tmp_path):
    with pytest.raises(BagError, match="varying steering"):
        from_bag(write_bag(tmp_path / "still", [(0.0, -2.0, 0.0)] * 60), ROOM, VIEW)
    moving = [(0.01 * i, -2.0 + 0.002 * i, 0.0) for i in range(60)]
    with pytest.raises(ConfigError, match=r"expected images of 336 x 188, .* got 60 x 40"):
        from_bag(write_bag(tmp_path / "small", moving, (40, 60)), ROOM, VIEW)


def test_frames_of_a_run_folder_are_the_plain_ones(tmp_path):
    rng = np.random.default_rng(0)
    textured = np.arange(12) % 2 == 1
    frames = Frames(
        rng.integers(0, 255, (12, 66, 200, 3)).astype(np.uint8), np.zeros((12, 3)),
        np.arange(12, dtype=np.float32) / 100, np.zeros((12, 0), np.float32), textured,
    )  # fmt: skip
    FrameStore(tmp_path / "policy" / "frames").append("stills-lab", frames)
    reference = from_run(tmp_path, VIEW)
    np.testing.assert_allclose(reference.steering_rad, np.arange(0, 12, 2) / 100, atol=1e-7)
    np.testing.assert_array_equal(reference.images, frames.images[::2])
    with pytest.raises(ConfigError, match="expected frames of 100 x 66"):
        from_run(tmp_path, PolicyView(VIEW.camera, width=100))
    with pytest.raises(ConfigError, match="found none"):
        from_run(tmp_path / "nothing", VIEW)


def test_the_twin_gives_left_and_right(monkeypatch):
    pytest.importorskip("mujoco")
    reference = from_twin(VIEW, count=8)
    assert reference.images.shape == (8, 66, 200, 3)
    assert reference.images.std() > 10
    assert reference.steering_rad.min() < 0.0 < reference.steering_rad.max()
    with pytest.raises(ConfigError, match="give frames of the policy's own camera"):
        from_twin(PolicyView(Pinhole(640, 480, 400.0, 400.0, 320.0, 240.0)), count=1)
