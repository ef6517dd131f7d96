"""Where the rows of theta lie on an object."""

import numpy as np
import pytest
import torch

from advnerf_core.fields.colour_grid import ColourGridError, colour_grid
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object


def lump(slots, free):
    """Voxels with one colour for each of ``free`` rows, and a hidden rest."""
    return VoxelGridObject(
        slots=np.asarray(slots, dtype=np.int32),
        theta_shape=(free, 3),
        fixed_colours=np.full((1, 3), 0.5),
        box_min=-np.ones(3),
        box_max=np.ones(3),
        T_world_from_object=np.eye(4),
    )


def test_a_face_is_its_texture():
    grid = colour_grid(cube_face_object(0.8, 3))
    assert grid.shape == (3, 3)
    assert grid.cells[4].tolist() == [1, 1]
    torch.testing.assert_close(grid.places[5], torch.tensor([0.5, 5 / 6]))


def test_voxels_lie_where_they_are_first_shown():
    slots = np.full((2, 3, 4), 3)
    slots[0, 1, 2], slots[1, 0, 3], slots[1, 2, 0] = 1, 0, 1  # row 2 is shown nowhere
    grid = colour_grid(lump(slots, 3))
    assert grid.shape == (2, 3, 4)
    assert grid.cells[:2].tolist() == [[1, 0, 3], [0, 1, 2]]
    assert len(grid.cells) == 3


def test_summed_levels_have_no_grid():
    with pytest.raises(ColourGridError, match="use the method random, or an object without summed levels"):
        colour_grid(with_summed_levels(lump(np.arange(8).reshape(2, 2, 2), 8), 2, 1, 2))
