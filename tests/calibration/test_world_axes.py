"""Up and ground of models whose world is known."""

import numpy as np
import pytest

from advnerf_core.geometry import look_at, make_transform, rotation_x, rotation_z
from calibration.world_axes import find_ground

WALK = np.stack(
    [look_at([3.0 * np.cos(a), 3.0 * np.sin(a), 1.2], [0.0, 0.0, 0.8]) for a in np.linspace(0.0, 5.0, 30)]
)
TILT = make_transform(rotation_x(2.0) @ rotation_z(1.0), [4.0, -2.0, 7.0])


def plane(rng, count, height_m, half_m, noise_m=0.003):
    return np.c_[rng.uniform(-half_m, half_m, (count, 2)), height_m + noise_m * rng.normal(size=count)]


def things(rng, count):
    return rng.uniform([-4.0, -4.0, 0.1], [4.0, 4.0, 3.0], (count, 3))


def in_model(points):
    return points @ TILT[:3, :3].T + TILT[:3, 3]


def angle_and_height(ground):
    """Angle of the ground from the true one [rad], and height of the true floor above it [m]."""
    up = TILT[:3, :3].T @ ground.up
    return float(np.arccos(min(1.0, up[2]))), float(TILT[:3, 3] @ ground.up - ground.height)


@pytest.mark.parametrize("seed", range(10))
def test_the_floor_is_found_below_tables_among_clutter(seed):
    rng = np.random.default_rng(seed)
    points = np.r_[plane(rng, 300, 0.0, 4.0), plane(rng, 200, 0.75, 0.6), things(rng, 1500)]
    reflections = plane(rng, 30, -0.8, 2.0)
    ground = find_ground(TILT @ WALK, in_model(np.r_[points, reflections]))
    angle, height_m = angle_and_height(ground)
    assert np.rad2deg(angle) < 0.2
    assert abs(height_m) < 0.01
    assert 280 <= ground.points <= 360


def test_clutter_without_a_floor_is_no_ground():
    rng = np.random.default_rng(0)
    assert find_ground(TILT @ WALK, in_model(things(rng, 2000))) is None
    assert find_ground(TILT @ WALK, in_model(plane(rng, 20, 0.0, 4.0))) is None
    assert find_ground(TILT @ WALK, np.zeros((0, 3))) is None


def test_a_wall_and_a_ceiling_are_no_ground():
    rng = np.random.default_rng(0)
    ceiling, wall = plane(rng, 500, 2.5, 4.0), plane(rng, 500, 4.0, 3.0)[:, [2, 0, 1]]
    assert find_ground(TILT @ WALK, in_model(np.r_[ceiling, wall])) is None
