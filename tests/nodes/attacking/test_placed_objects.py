"""Objects of a request: how their colours are given, and that their hash knows it."""

import numpy as np
import pytest

from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.model import ObjectModel, save_object
from advnerf_core.objects.voxel.voxelise import voxelise
from nodes.experiment.show.own_scene import own_objects
from tests.support.tiny_request import loaded, tiny_request, with_objects


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("objects")
    save_object(path / "hydrant.object.safetensors", ObjectModel("hydrant", voxelise(hydrant(), 12)))
    return path


def placed(folder, rest=""):
    thing = f"{{name: a, kind: hydrant.object.safetensors, x_m: 1.0, y_m: 0.0{rest}}}"
    (found,) = own_objects(loaded(with_objects(tiny_request(folder), thing)))
    return found


def test_summed_levels_change_what_is_searched_for_and_the_hash_but_not_the_shape(folder):
    dense, summed, fewer = placed(folder), placed(folder, ", levels: 4"), placed(folder, ", levels: 2")
    np.testing.assert_array_equal(summed.field.slots, dense.field.slots)
    # Grids of 2, 3, 7 and 12 cells along an edge: geometric from 2 to the longest side's voxels.
    longest = max(dense.field.slots.shape)
    sizes = sorted({round(float(n)) for n in np.geomspace(2, longest, 4)})
    assert summed.field.theta_shape == (sum(n**3 for n in sizes), 3)
    assert len({dense.named.sha256, summed.named.sha256, fewer.named.sha256}) == 3
    assert placed(folder, ", levels: 4").named == summed.named
