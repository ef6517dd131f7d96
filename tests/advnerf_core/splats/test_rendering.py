"""The kernels against closed forms and against plain torch."""

import numpy as np
import pytest
import torch

from advnerf_core.data.similarity import Similarity
from advnerf_core.geometry import Pinhole, look_at, make_transform
from advnerf_core.parallel import set_thread_count
from advnerf_core.splats.gaussians import GaussianSplats
from advnerf_core.splats.renderer import NEAR_M, SplatRenderer
from tests.support.splat_reference import render_reference
from tests.support.splats import gaussians, random_splats, room

LENS = Pinhole(53, 37, 60.0, 50.0, 25.5, 17.5)  # no multiple of a tile; (25, 17) is the middle of the view
AHEAD = np.eye(4)


def test_one_gaussian_has_the_pixel_values_of_its_formula():
    """Seen along z, a ball of deviation s at depth z has the covariance (f s / z)^2 + 0.3 px^2."""
    one = gaussians([[0.0, 0.0, 2.0]], 0.1, 0.8, [[1.0, 0.5, 0.25]])
    rgb, depth_m, alpha = SplatRenderer(one, behind=(0.0, 0.0, 1.0)).render(AHEAD[None], LENS)
    column, row = np.meshgrid(np.arange(53) - 25.0, np.arange(37) - 17.0)
    squared = column**2 / ((60.0 * 0.1 / 2.0) ** 2 + 0.3) + row**2 / ((50.0 * 0.1 / 2.0) ** 2 + 0.3)
    expected = 0.8 * np.exp(-0.5 * squared)
    expected[expected < 1.0 / 255.0] = 0.0
    np.testing.assert_allclose(alpha[0], expected, atol=1e-5)
    np.testing.assert_allclose(
        rgb[0],
        expected[..., None] * [1.0, 0.5, 0.25] + (1.0 - expected[..., None]) * [0.0, 0.0, 1.0],
        atol=1e-5,
    )
    assert torch.isinf(depth_m[0][alpha[0] == 0.0]).all()
    np.testing.assert_allclose(depth_m[0][alpha[0] > 0.01], 2.0, rtol=1e-5)


def test_the_opacity_is_clamped_and_the_nearer_gaussian_is_in_front():
    two = gaussians(
        [[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]], [[0.4] * 3, [0.2] * 3], 1.0, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    )
    rgb, depth_m, alpha = SplatRenderer(two).render(AHEAD[None], LENS)
    np.testing.assert_allclose(rgb[0, 17, 25], [0.99, 0.0099, 0.0], atol=1e-5)
    np.testing.assert_allclose(alpha[0, 17, 25], 1.0 - 0.01**2, atol=1e-5)
    np.testing.assert_allclose(depth_m[0, 17, 25], (0.99 * 2.0 + 0.0099 * 4.0) / 0.9999, rtol=1e-5)


def test_the_colour_depends_on_the_direction_as_the_harmonics_say():
    """With the coefficient of Y_10 = 0.4886 z alone, the same Gaussian is bright from below and dark from above."""
    one = gaussians([[0.0, 0.0, 0.0]], 0.2, 0.9, [[0.5, 0.5, 0.5]], bands=2)
    one.harmonics[0, 2] = 0.4
    seen = {}
    for side in (1.0, -1.0):
        pose = look_at(np.array([0.0, 1e-3, -2.0 * side]), np.zeros(3))
        rgb, _, alpha = SplatRenderer(one).render(pose[None], LENS)
        seen[side] = float(rgb[0, 17, 25, 0] / alpha[0, 17, 25])
    assert seen[1.0] == pytest.approx(0.5 + 0.4886025 * 0.4, abs=1e-4)
    assert seen[-1.0] == pytest.approx(0.5 - 0.4886025 * 0.4, abs=1e-4)


@pytest.mark.parametrize("bands", [1, 2, 3, 4])
def test_it_equals_plain_torch(bands):
    splats = random_splats(400, seed=bands, bands=bands)
    pose = look_at(np.array([-2.0, 0.4, 0.5]), np.array([1.0, 0.0, 0.0]))
    expected = render_reference(splats, pose, LENS, NEAR_M, (0.2, 0.4, 0.6))
    rgb, depth_m, alpha = SplatRenderer(splats, (0.2, 0.4, 0.6)).render(pose[None], LENS)
    assert float((rgb[0] - expected["rgb"]).abs().max()) < 1e-4
    assert float((alpha[0] - expected["alpha"]).abs().max()) < 1e-4
    found, right = depth_m[0], expected["depth_m"]
    assert torch.equal(torch.isinf(found), torch.isinf(right))
    seen = torch.isfinite(right)
    assert float((found - right)[seen].abs().max()) < 1e-4
    assert 0.3 < float(alpha.mean()) < 0.99


def test_it_equals_plain_torch_with_the_camera_among_needles_and_leaves():
    splats = random_splats(300, seed=9, spread_m=0.5)
    splats.scales_m[:100] *= np.array([30.0, 1.0, 1e-3], np.float32)
    expected = render_reference(splats, AHEAD, LENS, NEAR_M)
    rgb, _, alpha = SplatRenderer(splats).render(AHEAD[None], LENS)
    assert float((rgb[0] - expected["rgb"]).abs().max()) < 1e-4
    assert float((alpha[0] - expected["alpha"]).abs().max()) < 1e-4


def test_the_same_inputs_give_the_same_bits_for_any_number_of_threads():
    renderer, poses = (
        SplatRenderer(room(3000)),
        np.stack([look_at(np.array([x, 0.0, 0.0]), np.array([2.0, 1.0, 0.0])) for x in (-1.0, 0.0)]),
    )
    first = renderer.render(poses, LENS)
    set_thread_count(1)
    try:
        again = renderer.render(torch.from_numpy(poses), LENS)
    finally:
        set_thread_count(0)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_a_room_of_gaussians_looks_like_its_walls():
    size_m = (4.0, 4.0, 2.4)
    walls = room(60_000, size_m=size_m)
    pose = look_at(np.array([-1.0, 0.3, 0.0]), np.array([2.0, 0.0, 0.1]))
    rgb, depth_m, alpha = SplatRenderer(walls).render(pose[None], LENS)
    directions = LENS.directions() @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        walls_m = (np.sign(directions) * np.array(size_m) / 2.0 - pose[:3, 3]) / directions
    true_m, axis = walls_m.min(axis=-1), walls_m.argmin(axis=-1)
    points = pose[:3, 3] + directions * true_m[..., None]
    face = 2 * axis + (np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0.0)
    from tests.support.splats import wall_colours

    true = wall_colours(points.reshape(-1, 3), face.reshape(-1)).reshape(rgb[0].shape)
    assert float(alpha.min()) > 0.9
    assert np.abs(rgb[0].numpy() - true).mean() < 0.03
    assert np.median(np.abs(depth_m[0].numpy() - true_m)) < 0.03


def test_a_moved_splat_seen_by_a_moved_camera_is_the_same():
    splats = random_splats(300, seed=5)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    similarity = Similarity(2.5, make_transform(turn, [3.0, -2.0, 0.7]))
    pose = look_at(np.array([-2.0, 0.4, 0.5]), np.zeros(3))
    rgb, depth_m, _ = SplatRenderer(splats).render(pose[None], LENS)
    moved, moved_m, _ = SplatRenderer(splats.moved(similarity)).render(similarity.poses(pose)[None], LENS)
    np.testing.assert_allclose(moved, rgb, atol=2e-4)
    seen = torch.isfinite(depth_m)
    np.testing.assert_allclose(moved_m[seen], 2.5 * depth_m[seen], rtol=1e-3)


def test_gaussians_behind_and_beside_the_camera_are_not_drawn():
    aside = gaussians([[0.0, 0.0, -1.0], [0.0, 0.0, 0.01], [50.0, 0.0, 1.0]], 0.01, 0.9, np.ones((3, 3)))
    assert float(SplatRenderer(aside).render(AHEAD[None], LENS)[2].max()) == 0.0


def test_wrong_shapes_are_refused():
    good = random_splats(3)
    with pytest.raises(ValueError, match=r"expected harmonics \[3, 1 | 4 | 9 | 16, 3\]"):
        GaussianSplats(good.means_m, good.scales_m, good.rotations, good.opacities, good.harmonics[:, :5])
    with pytest.raises(ValueError, match=r"expected scales_m of shape \(3, 3\)"):
        GaussianSplats(good.means_m, good.scales_m[:2], good.rotations, good.opacities, good.harmonics)
    with pytest.raises(ValueError, match=r"expected poses \[B, 4, 4\]"):
        SplatRenderer(good).render(AHEAD, LENS)
