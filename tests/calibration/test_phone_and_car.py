import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from advnerf_core.data.lens import Lens
from advnerf_core.data.similarity import Similarity, SimilarityError
from advnerf_core.geometry import Pinhole, camera_mount, make_transform, planar_pose
from calibration.phone_and_car import place_in_mocap
from calibration.photo_model import Model, ReconstructionError, Registered

MOUNT = camera_mount(0.3, 0.0, 0.2, 0.17)
# How the model's world lies in motion capture's.
TRUE = Similarity(1.8, make_transform(Rotation.from_rotvec([1.0, 0.3, -0.7]).as_matrix(), [0.4, -2.0, 1.1]))
INVERSE = Similarity(
    1.0 / 1.8,
    make_transform(
        TRUE.T_target_from_source[:3, :3].T,
        -TRUE.T_target_from_source[:3, :3].T @ TRUE.T_target_from_source[:3, 3] / 1.8,
    ),
)


def drive(count=24, straight=False):
    angles = np.linspace(0.0, 5.0, count)
    if straight:
        return np.stack([planar_pose(a, 0.0, 0.0) @ MOUNT for a in angles])
    return np.stack([planar_pose(1.5 * np.cos(a), 1.5 * np.sin(a), a + 1.57) @ MOUNT for a in angles])


def walk(count=10):
    return np.stack(
        [planar_pose(2.0 * np.cos(a), 2.0 * np.sin(a), a) @ camera_mount(0.0, 0.0, 1.4) for a in range(count)]
    )


def model_of(phone, car, noise_m=0.0, seed=0):
    """A model in its own world of phone and car images, disturbed as structure from motion is."""
    rng = np.random.default_rng(seed)
    images = []
    for name, poses in (("phone", phone), ("car", car)):
        for index, pose in enumerate(INVERSE.poses(poses)):
            pose[:3, 3] += rng.normal(0.0, noise_m / 1.8, 3)
            images.append(
                Registered(f"{name}/{index}", name, pose, Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0), Lens())
            )
    points = INVERSE.points(np.array([[1.0, 2.0, 0.5], [0.0, 0.0, 2.0]]))
    return Model(tuple(images), (), points, 0.5, 1)


def mocap_of(car):
    return {f"car/{index}": pose for index, pose in enumerate(car)}


def test_phone_poses_and_points_come_out_metric_in_the_mocap_world():
    placed = place_in_mocap(model_of(walk(), drive()), mocap_of(drive()))
    np.testing.assert_allclose(placed.T_world_from_camera[:10], walk(), atol=1e-9)
    np.testing.assert_allclose(placed.points, [[1.0, 2.0, 0.5], [0.0, 0.0, 2.0]], atol=1e-9)
    assert placed.alignment.similarity.scale == pytest.approx(1.8)
    assert len(placed.shared) == 24


def test_a_wrong_mount_or_stamp_is_an_outlier_and_reported():
    mocap = mocap_of(drive())
    for late in (3, 4, 17):
        mocap[f"car/{late}"] = drive()[late + 1]  # one frame's pose came late
    placed = place_in_mocap(model_of(walk(), drive(), noise_m=0.005), mocap)
    frames = placed.summary()["frames"]
    assert [frame["image"] for frame in frames if not frame["used"]] == ["car/3", "car/4", "car/17"]
    assert placed.summary()["inliers"] == 21
    np.testing.assert_allclose(placed.T_world_from_camera[:10, :3, 3], walk()[:, :3, 3], atol=0.02)


def test_a_straight_drive_and_too_few_shared_frames_are_refused():
    straight = drive(straight=True)
    with pytest.raises(SimilarityError, match="on one line"):
        place_in_mocap(model_of(walk(), straight), mocap_of(straight))
    with pytest.raises(ReconstructionError, match=r"at least 6 frames of the car .* got 5 of 24"):
        place_in_mocap(model_of(walk(), drive()[:5]), mocap_of(drive()))


def test_poses_that_disagree_everywhere_are_refused():
    scrambled = mocap_of(drive()[np.random.default_rng(1).permutation(24)])
    with pytest.raises(SimilarityError, match=r"to agree within 0\.08 m"):
        place_in_mocap(model_of(walk(), drive()), scrambled)
