import numpy as np
import pytest
from numpy.typing import NDArray

from advnerf_core.render.march_kernels import march, span_in_box
from advnerf_core.render.occupancy import OccupancyGrid, leap_distances, refine_occupied

RNG = np.random.default_rng(0)
HIGH = np.array([1.0, 0.75, 0.5], np.float32)
SHAPE = (16, 12, 8)
CELLS = (np.array(SHAPE) / HIGH).astype(np.float32)


def random_rays(count: int) -> NDArray[np.float32]:
    origins = RNG.uniform(-0.3, 1.3, (count, 3))
    directions = RNG.normal(size=(count, 3))
    directions *= 0.125 / np.linalg.norm(
        directions, axis=1, keepdims=True
    )  # a box with a longest side of 8 m
    return np.concatenate([origins, directions], axis=1).astype(np.float32)


def walk(rays: NDArray[np.float32], occupied: NDArray[np.bool_], step_m: float):  # type: ignore[no-untyped-def]
    leaps = leap_distances(occupied, CELLS)
    room, count = 200_000, len(rays)
    points, t, widths = (
        np.empty((room, 3), np.float32),
        np.empty(room, np.float32),
        np.empty(room, np.float32),
    )
    begins, steps = np.zeros(count + 1, np.int64), np.array([step_m, step_m, 0.0], np.float32)
    half = np.full(count, 0.5, np.float32)
    fitted = march(
        rays,
        half,
        0,
        count,
        HIGH,
        np.float32(0.1),
        steps,
        leaps.distance,
        leaps.cells,
        points,
        t,
        widths,
        begins,
        1000,
    )
    assert fitted == count
    return points, t, widths, begins


def cell_of(points: NDArray[np.floating]) -> tuple[NDArray[np.int64], ...]:
    index = np.clip((points * CELLS).astype(int), 0, np.array(SHAPE) - 1)
    return tuple(index.T)


def test_leap_distances_are_chessboard_distances() -> None:
    occupied = RNG.random(SHAPE) > 0.98
    places = np.argwhere(occupied)
    everywhere = np.stack(np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij"), -1)
    brute = np.abs(everywhere[..., None, :] - places).max(-1).min(-1)
    np.testing.assert_array_equal(leap_distances(occupied, CELLS).distance, brute)


def test_span_is_where_the_ray_is_in_the_box() -> None:
    for ray in random_rays(50):
        start, end = span_in_box(ray, HIGH, np.float32(0.0))
        t = np.linspace(0, 30, 3001)
        points = ray[:3] + t[:, None] * ray[3:]
        inside = ((points >= 0) & (points <= HIGH)).all(1)
        np.testing.assert_array_equal(
            inside[np.abs(t - start) > 0.02], ((t > start) & (t < end))[np.abs(t - start) > 0.02]
        )


def test_samples_cover_exactly_the_occupied_length() -> None:
    occupied, rays, step_m = RNG.random(SHAPE) > 0.7, random_rays(60), 0.01
    _, t, widths, begins = walk(rays, occupied, step_m)
    fine = np.arange(0.1, 30, 0.0005)
    for r, ray in enumerate(rays):
        path = ray[:3] + fine[:, None] * ray[3:]
        inside = ((path >= 0) & (path <= HIGH)).all(1)
        truth = 0.0005 * occupied[cell_of(path[inside])].sum()
        mine = widths[begins[r] : begins[r + 1]].sum() / 0.125
        # Each visit to an occupied stretch overshoots by less than one interval.
        visits = 1 + int((np.diff(t[begins[r] : begins[r + 1]]) > 1.5 * step_m).sum())
        assert -0.01 <= mine - truth <= step_m * visits + 0.01


def test_an_empty_box_has_no_samples() -> None:
    _, _, _, begins = walk(random_rays(20), np.zeros(SHAPE, bool), 0.01)
    assert begins[-1] == 0


def test_occupancy_finds_a_ball_and_refinement_sharpens_it() -> None:
    def log_density(points: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.where(np.linalg.norm(points - 0.4 * HIGH, axis=1) < 0.12, 8.0, -8.0).astype(np.float32)

    grid = OccupancyGrid(HIGH, resolution=16)
    assert grid.occupied(1.0).all(), "before the first probe everything may be occupied"
    for step in range(6):
        grid.update(log_density, step, share=1.0)
    occupied = grid.occupied(1.0)
    centres = (np.argwhere(np.ones(grid.shape)) + 0.5) / grid.cells
    distance = np.linalg.norm(centres - 0.4 * HIGH, axis=1).reshape(grid.shape)
    assert occupied[distance < 0.09].all()
    assert not occupied[distance > 0.18].any()
    fine = refine_occupied(occupied, HIGH, log_density)
    assert fine.shape == tuple(2 * n for n in grid.shape)
    assert fine.mean() < occupied.mean()
    assert fine.mean() == pytest.approx(4 / 3 * np.pi * 0.12**3 / HIGH.prod(), rel=0.5)
