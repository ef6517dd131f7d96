import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object
from advnerf_core.geometry import Pinhole, look_at, make_transform, rotation_z
from advnerf_core.render.cast_object import cast_object
from advnerf_core.render.soft_pose import placed_at, placement_of
from tests.support.layers import render_soft

PINHOLE = Pinhole(30, 22, 26.0, 25.0, 15.0, 11.0)
POSES = np.stack([look_at([1.6, 0.3, 0.6], [0.1, 0.0, 0.2]), look_at([0.4, -1.7, 0.5], [0.1, 0.0, 0.2])])


def cloud(position_m=(0.1, 0.0, 0.2), thickness=8.0, least=0.0):
    count = 12
    i, j, k = (index / (count - 1) - 0.5 for index in np.indices((count,) * 3))
    density = thickness * np.clip(3.0 * (0.3 - np.sqrt(i**2 + 2 * j**2 + 1.5 * k**2)), least, 1.0)
    return VoxelGridObject(
        np.arange(count**3, dtype=np.int32).reshape((count,) * 3),
        (count**3, 3),
        np.zeros((0, 3)),
        -0.5 * np.ones(3),
        0.5 * np.ones(3),
        make_transform(rotation_z(0.3), position_m),
        scale=0.9,
        density=density,
        step_units=0.02,
    )


def colours_of(field, seed=0):
    return torch.randn(field.theta_shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("least", [0.0, -1.0], ids=["positive", "signed"])
def test_it_shows_what_the_sparse_cast_shows(least):
    field = cloud(least=least)
    theta = colours_of(field)
    colour, alpha, depth_m = render_soft(field, placement_of(field), theta, POSES, PINHOLE, 2)
    cast = cast_object(dataclasses.replace(field, step_units=0.002), POSES, PINHOLE, 2, np.float64)
    expected = np.zeros((2 * 22 * 30, 3))
    expected[cast.pixels] = cast.weights @ field.colours(theta).numpy()
    np.testing.assert_allclose(colour.reshape(-1, 3), expected, atol=4e-3)
    np.testing.assert_allclose(alpha.reshape(-1)[cast.pixels], cast.alpha, atol=4e-3)
    thick = cast.alpha > 0.1
    np.testing.assert_allclose(depth_m.reshape(-1)[cast.pixels[thick]], cast.depth_m[thick], atol=4e-3)


@pytest.mark.parametrize("least", [0.0, -1.0], ids=["positive", "signed"])
@pytest.mark.parametrize("axis", range(4), ids=["x", "y", "yaw", "scale"])
def test_derivatives_with_respect_to_the_placement_are_finite_differences(axis, least):
    field = cloud(least=least)
    theta, generator = colours_of(field), torch.Generator().manual_seed(1)
    probe = torch.randn(2, 22, 30, 4, dtype=torch.float64, generator=generator)

    def probed(placement):
        colour, alpha, _ = render_soft(field, placement, theta, POSES, PINHOLE, 1, least=0.0)
        return (torch.cat([colour, alpha[..., None]], -1) * probe).sum()

    # Away from where the object was made, so that nothing is special about the place.
    placement = (placement_of(field) + torch.tensor([0.03, -0.02, 0.1, 0.05])).requires_grad_()
    (gradient,) = torch.autograd.grad(probed(placement), placement)
    step = torch.zeros(4, dtype=torch.float64)
    step[axis] = 1e-6
    with torch.no_grad():
        difference = (probed(placement + step) - probed(placement - step)) / 2e-6
    assert abs(difference) > 1e-2
    torch.testing.assert_close(gradient[axis], difference, rtol=1e-4, atol=1e-4)


def test_colours_have_the_gradient_of_the_sparse_product():
    field = cloud()
    theta = colours_of(field).requires_grad_()
    colour, _, _ = render_soft(field, placement_of(field), theta, POSES, PINHOLE, 2)
    probe = torch.randn(colour.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (gradient,) = torch.autograd.grad((colour * probe).sum(), theta)
    cast = cast_object(dataclasses.replace(field, step_units=0.002), POSES, PINHOLE, 2, np.float64)
    c = torch.sigmoid(theta.detach()).numpy()
    expected = cast.weights.T @ probe.reshape(-1, 3).numpy()[cast.pixels] * c * (1 - c)
    np.testing.assert_allclose(gradient, expected, atol=0.02 * np.abs(expected).max())


def test_a_placement_moves_the_object_there():
    moved = placed_at(cloud(), torch.tensor([1.0, 2.0, -0.5, 0.7]))
    np.testing.assert_allclose(placement_of(moved), [1.0, 2.0, -0.5, 0.7])
    assert moved.T_world_from_object[2, 3] == 0.2


def test_what_cannot_be_differentiated_is_refused():
    field = cloud()
    solid = cube_face_object()
    with pytest.raises(ValueError, match="expected an object with a density"):
        render_soft(solid, placement_of(solid), colours_of(solid), POSES, PINHOLE)
    for bad in ([0.0, 0.0, np.nan, 1.0], [0.0, 0.0, 0.0, -1.0]):
        with pytest.raises(ValueError, match="expected a finite placement"):
            render_soft(field, torch.tensor(bad), colours_of(field), POSES, PINHOLE)


def test_an_object_out_of_view_gives_an_empty_layer():
    field = cloud((0.0, 30.0, 0.2))
    colour, alpha, depth_m = render_soft(field, placement_of(field), colours_of(field), POSES[:1], PINHOLE)
    assert not colour.any()
    assert not alpha.any()
    assert bool(torch.isinf(depth_m).all())
