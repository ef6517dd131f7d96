import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from advnerf_core.data.similarity import (
    Similarity,
    SimilarityError,
    align_poses,
    extent,
    fit_positions,
    rotation_angles,
)
from advnerf_core.geometry import make_transform

TOLERANCES = (0.05, np.deg2rad(2.0))
TRUE = Similarity(0.37, make_transform(Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), [3.0, -7.0, 0.5]))


def cameras(count=30, seed=0, spread=(4.0, 3.0, 0.3)):
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, random_state=seed).as_matrix()
    return np.stack([make_transform(R, rng.normal(0.0, spread)) for R in rotations])


def disturbed(poses, position_m, angle_rad, seed=1):
    rng = np.random.default_rng(seed)
    noisy = poses.copy()
    noisy[:, :3, 3] += rng.normal(0.0, position_m, (len(poses), 3))
    noisy[:, :3, :3] = (
        Rotation.from_rotvec(rng.normal(0.0, angle_rad, (len(poses), 3))).as_matrix() @ poses[:, :3, :3]
    )
    return noisy


def test_exact_poses_give_back_the_similarity():
    source = cameras()
    found = align_poses(source, TRUE.poses(source), *TOLERANCES)
    assert found.similarity.scale == pytest.approx(TRUE.scale, rel=1e-12)
    np.testing.assert_allclose(found.similarity.T_target_from_source, TRUE.T_target_from_source, atol=1e-11)
    assert found.inliers.all()
    assert found.rms_position_m < 1e-12
    assert found.rms_rotation_rad < 1e-12


def test_poses_stay_rigid_and_points_follow_the_formula():
    source = cameras(4)
    moved = TRUE.poses(source)
    np.testing.assert_allclose(
        moved[:, :3, :3] @ np.swapaxes(moved[:, :3, :3], 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12
    )
    R, t = TRUE.T_target_from_source[:3, :3], TRUE.T_target_from_source[:3, 3]
    for k in range(4):
        np.testing.assert_allclose(TRUE.points(source[k, :3, 3]), 0.37 * R @ source[k, :3, 3] + t)


def test_a_third_of_wrong_poses_is_thrown_out():
    source = cameras()
    target = disturbed(TRUE.poses(source), 0.005, 0.003)
    rng = np.random.default_rng(5)
    target[:6, :3, 3] += rng.normal(0.0, 2.0, (6, 3))
    target[6:10, :3, :3] = Rotation.random(
        4, random_state=6
    ).as_matrix()  # in the right place, looking elsewhere
    found = align_poses(source, target, *TOLERANCES)
    assert found.inliers.tolist() == [False] * 10 + [True] * 20
    assert found.similarity.scale == pytest.approx(TRUE.scale, rel=5e-3)
    error = found.similarity.points(source[:, :3, 3]) - TRUE.points(source[:, :3, 3])
    assert np.abs(error).max() < 0.01
    assert (found.position_error_m[:6] > 0.05).all()
    assert found.summary()["inliers"] == 20


def test_no_small_change_of_the_similarity_fits_better():
    source = cameras(12)
    target = TRUE.poses(source)
    target[:, :3, 3] += np.random.default_rng(2).normal(0.0, 0.01, (12, 3))
    found = align_poses(source, target, *TOLERANCES)

    def cost(scale, rotvec, t):
        R = Rotation.from_rotvec(rotvec).as_matrix()
        q = target[:, :3, 3] - target[:, :3, 3].mean(axis=0)
        arm2 = (q**2).sum(axis=1).mean()
        places = ((target[:, :3, 3] - scale * source[:, :3, 3] @ R.T - t) ** 2).sum()
        return places + arm2 * ((target[:, :3, :3] - R @ source[:, :3, :3]) ** 2).sum()

    s, T = found.similarity.scale, found.similarity.T_target_from_source
    base = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    least = cost(s, base, T[:3, 3])
    rng = np.random.default_rng(3)
    for _ in range(200):
        step = rng.normal(0.0, 1e-3, 7)
        assert cost(s + step[0], base + step[1:4], T[:3, 3] + step[4:]) > least


def test_without_tolerances_every_camera_is_fitted():
    source = cameras()
    target = disturbed(TRUE.poses(source), 0.2, 0.1)
    found = align_poses(source, target, np.inf, np.inf, min_inlier_share=1.0)
    assert found.inliers.all()
    noise = np.linalg.norm((target - TRUE.poses(source))[:, :3, 3], axis=1)
    assert found.rms_position_m == pytest.approx(np.sqrt((noise**2).mean()), rel=0.1)


@pytest.mark.parametrize(
    ("spread", "message"),
    [((4.0, 0.0, 0.0), "on one line"), ((4.0, 0.01, 0.01), "on one line"), ((0.0, 0.0, 0.0), "at one place")],
)
def test_cameras_that_fix_no_similarity_are_refused(spread, message):
    source = cameras(spread=spread)
    with pytest.raises(SimilarityError, match=rf"spread over an area, got all 30 {message}"):
        align_poses(source, TRUE.poses(source), *TOLERANCES)


def test_too_few_and_disagreeing_cameras_are_refused():
    with pytest.raises(SimilarityError, match="at least 3 cameras"):
        align_poses(cameras(2), TRUE.poses(cameras(2)), *TOLERANCES)
    with pytest.raises(SimilarityError, match=r"at least 15 of 30 cameras to agree"):
        align_poses(cameras(seed=1), cameras(seed=2), *TOLERANCES)
    broken = cameras()
    broken[3, 0, 3] = np.nan
    with pytest.raises(SimilarityError, match="finite poses"):
        align_poses(broken, TRUE.poses(cameras()), *TOLERANCES)


def test_extent_and_small_angles():
    assert extent([[0, 0, 0], [3, 4, 0], [1, 1, 1]]) == pytest.approx(5.0)
    angles = np.array([1e-9, 1e-4, 1.0, np.pi - 1e-6])
    R = Rotation.from_rotvec(angles[:, None] * np.array([0.6, 0.0, 0.8])).as_matrix()
    np.testing.assert_allclose(rotation_angles(R), angles, rtol=1e-6)


UP = TRUE.T_target_from_source[:3, :3].T @ [0.0, 0.0, 1.0]


def test_positions_alone_give_the_similarity():
    source = np.random.default_rng(0).normal(size=(6, 3))
    found, on_line = fit_positions(source, TRUE.points(source), [1.0, 0.0, 0.0])
    assert not on_line
    assert found.scale == pytest.approx(TRUE.scale)
    np.testing.assert_allclose(found.T_target_from_source, TRUE.T_target_from_source, atol=1e-9)


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.3, -2.0, 0.4], [-1.0, 1.0, 0.2]])
@pytest.mark.parametrize("count", [2, 5])
def test_up_settles_the_turn_about_a_line(direction, count):
    target = np.linspace(0.0, 3.0, count)[:, None] * np.array(direction)
    back = (target - TRUE.T_target_from_source[:3, 3]) @ TRUE.T_target_from_source[:3, :3] / TRUE.scale
    found, on_line = fit_positions(back, target, UP)
    assert on_line
    np.testing.assert_allclose(found.T_target_from_source, TRUE.T_target_from_source, atol=1e-9)
    tilted = UP + 0.05 * np.cross(UP, TRUE.T_target_from_source[:3, :3].T @ direction)
    np.testing.assert_allclose(fit_positions(back, target, tilted)[0].points(back), target, atol=1e-9)


def test_positions_at_one_place_or_above_each_other_are_refused():
    with pytest.raises(SimilarityError, match="at different places"):
        fit_positions(np.zeros((3, 3)), np.ones((3, 3)), [0.0, 0.0, 1.0])
    lift = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    with pytest.raises(SimilarityError, match="not above each other"):
        fit_positions(lift, lift, [0.0, 1.0, 0.0])
