"""Objects of a request: how their colours are given, and that their hash knows it."""

import numpy as np
import pytest

from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.model import ObjectModel, save_object
from advnerf_core.objects.voxel.voxelise import voxelise
from nodes.experiment.node.objects import place
from nodes.experiment.node.request import ObjectRequest


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("objects") / "hydrant.object.safetensors"
    save_object(path, ObjectModel("hydrant", voxelise(hydrant(), 12)))
    return path


def placed(file, **changes):
    return place(ObjectRequest(kind="file", file=file, x_m=1.0, y_m=0.0, z_m=0.0, **changes))


def test_summed_levels_change_what_is_searched_for_and_the_hash_but_not_the_shape(file):
    dense, summed, fewer = placed(file), placed(file, levels=4), placed(file, levels=2)
    np.testing.assert_array_equal(summed.field.slots, dense.field.slots)
    # Grids of 2, 3, 7 and 12 cells along an edge: geometric from 2 to the longest side's voxels.
    longest = max(dense.field.slots.shape)
    sizes = sorted({round(float(n)) for n in np.geomspace(2, longest, 4)})
    assert summed.field.theta_shape == (sum(n**3 for n in sizes), 3)
    assert len({dense.sha256, summed.sha256, fewer.sha256}) == 3
    assert placed(file, levels=4).sha256 == summed.sha256


def test_levels_are_for_files_only():
    with pytest.raises(ValueError, match="kind 'file' only"):
        ObjectRequest(kind="face", x_m=0.0, y_m=0.0, z_m=0.0, levels=3)
