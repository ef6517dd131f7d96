"""Empty boxes about cells, against a count of the occupied cells in each."""

import numpy as np
import pytest

from advnerf_core.render.occupancy import FLAT, FLATNESS, MAX_HEIGHT, MAX_REACH, flat_boxes, leap_distances


@pytest.mark.parametrize("share", [0.0, 0.0005, 0.01, 1.0])
def test_boxes_are_empty_and_no_smaller_than_the_cube(share):
    occupied = np.random.default_rng(1).random((60, 47, 21)) < share
    cubes = leap_distances(occupied, np.ones(3)).distance
    boxes = flat_boxes(cubes).astype(int)
    assert ((boxes == 0) == occupied).all()
    up = np.where(boxes >= FLAT, boxes - FLAT, boxes)
    across = np.where(boxes >= FLAT, FLATNESS * up, up)
    assert (across >= cubes).all()
    for cell in np.random.default_rng(2).integers(0, occupied.shape, (2000, 3)):
        assert occupied[about(cell, across, up)].sum() == (1 if occupied[tuple(cell)] else 0)
        if boxes[tuple(cell)] >= FLAT:  # the next flatter box is not empty, or higher than any
            assert up[tuple(cell)] == MAX_HEIGHT or occupied[about(cell, across + FLATNESS, up + 1)].any()
    assert cubes.max() <= MAX_REACH < FLAT


def test_low_over_a_floor_the_box_is_wide():
    occupied = np.zeros((64, 64, 32), bool)
    occupied[:, :, 0] = True
    assert flat_boxes(leap_distances(occupied, np.ones(3)).distance)[32, 32, 5] == FLAT + 5


def about(cell, across, up):
    """The cells nearer than ``across`` along x and y, and than ``up`` along z; of an occupied cell itself alone."""
    reach = [max(int(each[tuple(cell)]) - 1, 0) for each in (across, across, up)]
    return tuple(slice(max(c - r, 0), c + r + 1) for c, r in zip(cell, reach, strict=True))
