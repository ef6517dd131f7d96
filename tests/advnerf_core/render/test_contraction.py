"""Contracted space: the map against its definition, leaps against walking in tiny steps, occupancy against closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray

from advnerf_core.render.contraction import FAR, bounded_distances, into_cube, radial_stretch, span_before_far
from advnerf_core.render.march import MarchConfig, Marcher, Samples
from advnerf_core.render.occupancy import OccupancyGrid, leap_distances, refine_occupied
from tests.support.contraction import contract

SIDE_M = 8.0
CELLS = 16
ONES = np.ones(3, np.float32)


def uncontract(cube):
    """Inverse of ``contract``; NaN in the corners that no place is mapped to, infinite on the cube's surface."""
    c = 4.0 * np.asarray(cube, np.float64) - 2.0
    size = np.abs(c)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = 1.0 / (2.0 - size.max(axis=-1, keepdims=True))
        largest = np.arange(3) == size.argmax(axis=-1)[..., None]
        y = np.where(size.max(axis=-1, keepdims=True) <= 1.0, c, np.where(largest, np.sign(c) * r, c * r))
    y[(size > 1.0).sum(axis=-1) > 1] = np.nan
    return np.asarray(0.5 * y + 0.5)


def random_rays(count: int, seed: int, reach: float = 0.5) -> NDArray[np.float32]:
    """Rays in box coordinates that start around the inner region's centre; their parameter is in metres."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= SIDE_M * np.linalg.norm(directions, axis=1, keepdims=True)
    return np.concatenate([0.5 + rng.uniform(-reach, reach, (count, 3)), directions], axis=1).astype(
        np.float32
    )


def cell_of(points: NDArray[np.floating], cells: int) -> tuple[NDArray[np.int64], ...]:
    return tuple(np.clip((contract(points) * cells).astype(int), 0, cells - 1).T)


def walk(rays: NDArray[np.float32], occupied: NDArray[np.bool_], march: MarchConfig) -> Samples:
    leaps = leap_distances(occupied, np.array(occupied.shape, np.float32))
    marcher = Marcher(8 * (len(rays) * 4000 + march.max_samples), march, ONES, contracted=True)
    samples, kept = marcher(rays, np.full(len(rays), 0.5, np.float32), leaps)
    assert len(kept) == len(rays)
    return samples


@pytest.mark.parametrize(
    ("y", "expected"),
    [
        ((0.3, -0.9, 1.0), (0.3, -0.9, 1.0)),
        ((4.0, 1.0, -2.0), (1.75, 0.25, -0.5)),
        ((-0.5, -2.0, 1.0), (-0.25, -1.5, 0.5)),
        ((10.0, 0.0, -100.0), (0.1, 0.0, -1.99)),
    ],
)
def test_places_by_hand(y: tuple[float, ...], expected: tuple[float, ...]) -> None:
    cube = contract(0.5 * (np.array(y) + 1.0))
    np.testing.assert_allclose(4.0 * cube - 2.0, expected, atol=1e-12)


def test_the_inverse_and_the_kernel_agree_with_the_map() -> None:
    rng = np.random.default_rng(0)
    points = 0.5 + rng.normal(size=(4000, 3)) * 10.0 ** rng.uniform(-1, 2, (4000, 1))
    cube = contract(points)
    assert cube.min() >= 0.0
    assert cube.max() <= 1.0
    np.testing.assert_allclose(uncontract(cube), points, rtol=1e-9, atol=1e-9)
    kernel = np.array([into_cube(*p) for p in points[:500].astype(np.float32)])
    np.testing.assert_allclose(kernel, cube[:500], atol=2e-6)


def test_it_is_continuous_at_the_inner_region_and_leaves_the_corners_empty() -> None:
    rng = np.random.default_rng(1)
    face = rng.uniform(0.0, 1.0, (200, 3))
    face[:, 0] = 1.0
    tiny = np.array([1e-9, 0.0, 0.0])
    np.testing.assert_allclose(contract(face + tiny), contract(face - tiny), atol=1e-8)
    assert np.isnan(uncontract([0.9, 0.9, 0.5])).all()
    stretch = radial_stretch((CELLS,) * 3)
    centres = (np.argwhere(np.ones((CELLS,) * 3)) + 0.5) / CELLS
    reached = ~np.isnan(uncontract(centres)).any(axis=1)
    np.testing.assert_array_equal(stretch.reshape(-1) > 0.0, reached)
    assert reached.mean() == 0.5  # the inner region is an eighth of the cube, each outer one a sixteenth
    # Outwards, a small step in the cube is so many times longer in space.
    step = np.zeros_like(centres)
    axis = np.abs(centres - 0.5).argmax(axis=1)
    step[np.arange(len(axis)), axis] = 1e-6
    lengths = np.linalg.norm(uncontract(centres + step) - uncontract(centres - step), axis=1) / (2 * 2e-6)
    outside = reached & (np.abs(centres - 0.5).max(axis=1) > 0.25)
    # Along the axis only: the other coordinates, too, move outwards by their share.
    along = np.abs(uncontract(centres + step) - uncontract(centres - step))[np.arange(len(axis)), axis] / (
        2 * 2e-6
    )
    np.testing.assert_allclose(along[outside], stretch.reshape(-1)[outside], rtol=1e-4)
    np.testing.assert_allclose(lengths[reached & ~outside], 1.0, rtol=1e-6)


def test_leaps_leave_out_exactly_what_is_empty() -> None:
    rng = np.random.default_rng(2)
    occupied, rays, step_m, until_m = rng.random((CELLS,) * 3) > 0.7, random_rays(25, 3, 2.0), 0.05, 60.0
    march = MarchConfig(
        near_m=0.1, smallest_step_m=step_m, largest_step_m=step_m, step_growth=0.0, max_samples=9000
    )
    samples = walk(rays, occupied, march)
    fine_m = 0.0025
    t = np.arange(0.1, until_m, fine_m) + 0.5 * fine_m
    for r, ray in enumerate(rays):
        truth = occupied[cell_of(ray[:3] + t[:, None] * ray[3:], CELLS)]
        mine = samples.t_mid_m[samples.begins[r] : samples.begins[r + 1]].astype(np.float64)
        mine = mine[mine < until_m - step_m]
        # Everything occupied lies in some interval, but for the slack that keeps rays from being trapped on faces.
        nearest = np.abs(
            t[truth & (t < until_m - 2 * step_m), None]
            - _nearest(mine, t[truth & (t < until_m - 2 * step_m)])[:, None]
        )
        assert nearest.size == 0 or nearest.max() < 0.5 * step_m + 0.01
        visits = 1 + int((np.diff(mine) > 1.5 * step_m).sum())
        assert len(mine) * step_m - fine_m * truth.sum() <= step_m * visits + 0.01 * visits + step_m


def _nearest(sorted_values: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    right = np.clip(np.searchsorted(sorted_values, at), 1, len(sorted_values) - 1)
    left = right - 1
    closer = np.abs(sorted_values[left] - at) < np.abs(sorted_values[right] - at)
    return np.where(closer, sorted_values[left], sorted_values[right])


def test_a_thin_shell_far_outside_is_found_where_its_closed_form_says() -> None:
    radius, cells = 30.0, 128  # half sides
    rays = random_rays(300, 4).astype(np.float64)
    origin, direction = 2.0 * rays[:, :3] - 1.0, 2.0 * rays[:, 3:]
    a, b = (direction**2).sum(1), (origin * direction).sum(1)
    hit_m = (-b + np.sqrt(b * b - a * ((origin**2).sum(1) - radius**2))) / a
    occupied = np.zeros((cells,) * 3, np.bool_)
    occupied[cell_of(rays[:, :3] + hit_m[:, None] * rays[:, 3:], cells)] = True
    samples = walk(rays.astype(np.float32), occupied, MarchConfig(near_m=0.05, max_samples=500))
    half = 0.5 * samples.widths * SIDE_M
    for r in range(len(rays)):
        part = slice(samples.begins[r], samples.begins[r + 1])
        distance = np.abs(samples.t_mid_m[part] - hit_m[r]) - half[part]
        assert distance.min() < 2e-3 * hit_m[r]
    # A cell is as deep as the shell is far: some thirty intervals. Without leaps rays take over two hundred to get there.
    assert len(samples.points) / len(rays) < 60
    # Points are where the field is asked: in the cube.
    first = samples.begins[:-1]
    at = rays[:, :3] + samples.t_mid_m[first, None] * rays[:, 3:]
    np.testing.assert_allclose(samples.points[first], contract(at), atol=1e-5)


def test_intervals_grow_outside_and_rays_end() -> None:
    rays = random_rays(50, 5)
    march = MarchConfig(
        near_m=0.1, smallest_step_m=0.004, largest_step_m=0.05, step_growth=0.016, max_samples=1024
    )
    samples = walk(rays, np.ones((CELLS,) * 3, np.bool_), march)
    for r, ray in enumerate(rays):
        part = slice(samples.begins[r], samples.begins[r + 1])
        t, widths_m = samples.t_mid_m[part], SIDE_M * samples.widths[part]
        start = t - 0.5 * widths_m
        y = np.abs(2.0 * (ray[:3] + start[:, None] * ray[3:]) - 1.0).max(axis=1)
        cap = 0.05 * np.maximum(1.0, y) ** 2
        np.testing.assert_allclose(widths_m, np.minimum(np.maximum(0.016 * start, 0.004), cap), rtol=1e-3)
        start_m, end_m = span_before_far(ray, np.float32(0.1))
        assert start_m == np.float32(0.1)
        assert np.abs(2.0 * (ray[:3] + end_m * ray[3:]) - 1.0).max() == pytest.approx(FAR, rel=1e-4)
        assert t[-1] + widths_m[-1] > 0.98 * end_m


def test_distances_of_the_distortion_loss_are_bounded_and_their_intervals_the_derivative() -> None:
    t = np.linspace(0.01, 90.0, 500, dtype=np.float32)
    short = np.full(500, 1e-3, np.float32)
    s, ds = bounded_distances(t, short)
    np.testing.assert_allclose(s, [v if v <= 1 else 2 - 1 / v for v in t], rtol=1e-6)
    assert (s < 2.0).all()
    low, high = (bounded_distances((t + sign * 5e-4).astype(np.float64), short)[0] for sign in (-1, 1))
    np.testing.assert_allclose(ds, high - low, rtol=0.02, atol=3e-7)


def test_cells_count_by_the_optical_depth_of_crossing_them() -> None:
    density, cells = 0.5, 16

    def log_density(points: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.full(len(points), np.log(density), np.float32)

    grid = OccupancyGrid(ONES, resolution=14, contracted=True)
    assert grid.shape == (cells,) * 3
    grid.update(log_density, 1, share=1.0)
    stretch = radial_stretch(grid.shape)
    np.testing.assert_array_equal(grid.occupied(0.49), stretch > 0.0)
    # Twice as fine: in the inner region a part is 2 / 32 of a box side long, farther out by the stretch.
    fine = radial_stretch((2 * cells,) * 3)
    for least in (0.02, 0.04, 1.0):
        kept = refine_occupied(stretch > 0.0, ONES, log_density, least_depth=least, contracted=True)
        np.testing.assert_array_equal(kept, density * 2.0 * fine / 32 >= least)
    assert not refine_occupied(stretch > 0.0, ONES, log_density, least_depth=0.04)[16, 16, 16]
