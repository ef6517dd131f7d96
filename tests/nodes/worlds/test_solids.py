"""What worlds say their car can hit, against their own test of a free place."""

import numpy as np
import pytest
import torch

from advnerf_core.driving.solids import Rectangle, Solids
from hardware.worlds.junction.scene import Intersection
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.furniture import vehicle_in_room
from hardware.worlds.lab.lab import Lab
from hardware.worlds.world import HasSolids


def rectangle(footprint):
    return Rectangle(
        footprint.x_m, footprint.y_m, footprint.half_length_m, footprint.half_width_m, footprint.yaw_rad
    )


@pytest.mark.parametrize("kind", ["lab", "junction"])
def test_a_clearance_above_zero_is_a_free_place(kind):
    world = Lab(LabConfig()) if kind == "lab" else Intersection(Intersection.Config())
    fits = vehicle_in_room(LabConfig()).fits if kind == "lab" else world.fits
    half_m = 3.2 if kind == "lab" else 25.0  # the junction ends where it is not solid
    assert isinstance(world, HasSolids)
    solids = Solids(tuple(map(rectangle, world.solids)), rectangle(world.car_body))
    poses = np.random.default_rng(0).uniform(-1.0, 1.0, (400, 3)) * (half_m, half_m, np.pi)
    clearance = solids.clearances_m(torch.from_numpy(poses)).amin(1).numpy()
    free = np.array([fits(*pose) for pose in poses])
    assert 40 < free.sum() < 360
    np.testing.assert_array_equal(clearance >= 0.0, free)
