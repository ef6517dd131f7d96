"""Movable objects in plain torch against the kernels: picture, and gradient with respect to placement and colours."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.render.soft_pose import placement_of, soft_layer
from tests.advnerf_core.render.test_soft_pose import PINHOLE, POSES, cloud

CPU = torch.device("cpu")


@pytest.mark.parametrize("one_sided", [False, True])
@pytest.mark.parametrize("supersample", [1, 2])
def test_pictures_and_gradients_are_those_of_the_kernels(one_sided, supersample):
    field = dataclasses.replace(cloud(least=-1.0), one_sided=one_sided)
    placement = placement_of(field) + torch.tensor([0.05, -0.1, 0.3, 0.1], dtype=torch.float64)
    colours = np.random.default_rng(0).random((field.slot_count, 3))
    ours, theirs = (
        soft_layer(field, placement, colours, POSES, PINHOLE, supersample, device=device)
        for device in (None, CPU)
    )
    assert len(ours.pixels) > 30
    np.testing.assert_array_equal(theirs.pixels, ours.pixels)
    for name in ("colour", "alpha", "depth_m"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), atol=1e-12, err_msg=name)
    slopes = np.random.default_rng(1).normal(size=(len(ours.pixels), 4))
    for found, wanted in zip(theirs.pull(slopes), ours.pull(slopes), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-10 * np.abs(wanted).max())
    assert theirs.pull(slopes, with_colours=False)[1].shape == (0, 3)
    for found, again in zip(theirs.pull(slopes), theirs.pull(slopes), strict=True):
        np.testing.assert_array_equal(found, again)


def test_an_object_out_of_sight_has_no_pixels_and_no_gradient():
    field = cloud((9.0, -9.0, 0.2))
    layer = soft_layer(
        field, placement_of(field), np.zeros((field.slot_count, 3)), POSES, PINHOLE, device=CPU
    )
    assert len(layer.pixels) == 0
    by_place, by_colour = layer.pull(np.zeros((0, 4)))
    assert not by_place.any()
    assert by_colour.shape == (field.slot_count, 3)
