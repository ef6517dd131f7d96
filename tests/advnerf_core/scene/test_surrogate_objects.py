"""Several objects in one scene, opaque composition, and parameters that are mixed before they are squashed."""

import dataclasses
from functools import partial

import numpy as np
import pytest
import torch

from advnerf_core.fields.seen_rows import SeenRows
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import VoxelGridObject, squash
from advnerf_core.geometry import Pinhole, camera_mount, make_transform, rotation_z
from advnerf_core.parallel import Work
from advnerf_core.scene.surrogate import RendersInParts, Surrogate

PINHOLE = Pinhole(40, 26, 25.0, 25.0, 20.0, 11.0)
MOUNT = camera_mount(0.3, 0.0, 0.2, 0.17)
STATES = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.1, 0.15]], dtype=torch.float64)


def wall(poses, pinhole):
    rgb = torch.full((len(poses), pinhole.height, pinhole.width, 3), 0.4, dtype=torch.float64)
    return rgb, torch.full(rgb.shape[:3], 2.2, dtype=torch.float64)


class WallInParts:
    """The wall, each image of which is drawn by a part of its own; by no call."""

    def __call__(self, poses, pinhole):
        raise AssertionError("expected to be asked for its parts")

    def work(self, poses, pinhole):
        rgb, depth_m = (torch.full_like(each, torch.nan) for each in wall(poses, pinhole))

        def draw(b):
            drawn = wall(poses[b : b + 1], pinhole)
            rgb[b], depth_m[b] = drawn[0][0], drawn[1][0]

        return Work([partial(draw, b) for b in range(len(poses))], lambda: (rgb, depth_m, depth_m))


def cloud(x_m, y_m, density=6.0, count=8):
    shape = (count,) * 3
    slots = np.minimum(np.arange(count**3), count**3 - 20).astype(np.int32).reshape(shape)
    i, j, k = np.indices(shape)
    inside = (i - 3.5) ** 2 + (j - 3.5) ** 2 + (k - 3.5) ** 2 < 10
    return VoxelGridObject(
        slots,
        (count**3 - 20, 3),
        np.array([[0.1, 0.2, 0.3]]),
        -0.3 * np.ones(3),
        0.3 * np.ones(3),
        make_transform(rotation_z(x_m), [x_m, y_m, 0.2]),
        density=np.where(inside, density, 0.0),
        step_units=0.02,
    )


def surrogate(objects, **options):
    return Surrogate(wall, PINHOLE, MOUNT, objects, dtype=torch.float64, **options)


def assert_vjp_is_the_derivative(scene, seed=0):
    generator = torch.Generator().manual_seed(seed)
    theta, direction = (
        torch.randn(scene.theta_shape, dtype=torch.float64, generator=generator) for _ in range(2)
    )
    poses, h = scene.camera_poses(STATES), 1e-5
    probe = torch.randn(2, 3, 26, 40, dtype=torch.float64, generator=generator)
    gradient = scene.render(poses, theta).vjp(probe)
    plus, minus = (scene.render(poses, theta + s * h * direction).images for s in (1, -1))
    torch.testing.assert_close(
        (gradient * direction).sum(), ((plus - minus) * probe).sum() / (2 * h), rtol=1e-7, atol=1e-9
    )


def test_a_scene_drawn_beside_the_objects_gives_the_same_bits():
    called = surrogate([cloud(1.5, 0.1), cloud(2.4, 0.2)])
    beside = called.with_background(WallInParts())
    assert isinstance(beside.background, RendersInParts)
    theta = called.initial_theta(torch.Generator().manual_seed(0))
    slopes = torch.randn(2, 3, 26, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    ours, theirs = (each.render(each.camera_poses(STATES), theta) for each in (called, beside))
    assert torch.equal(ours.images, theirs.images)
    assert torch.equal(ours.vjp(slopes), theirs.vjp(slopes))


def test_the_order_in_which_objects_are_named_does_not_matter():
    near, middle, far = cloud(1.2, 0.1), cloud(1.6, -0.1, 3.0), cloud(1.9, 0.2)
    scene, shuffled = surrogate([near, middle, far]), surrogate([far, near, middle])
    theta = torch.randn(scene.theta_shape, dtype=torch.float64)
    parts = theta.split([near.parameter_count] * 3)
    poses = scene.camera_poses(STATES)
    a, b = scene.render(poses, theta), shuffled.render(poses, torch.cat([parts[2], parts[0], parts[1]]))
    torch.testing.assert_close(a.images, b.images, atol=1e-12, rtol=0)
    ga, gb = (
        rendered.vjp(torch.ones_like(rendered.images)).split([near.parameter_count] * 3)
        for rendered in (a, b)
    )
    for mine, other in zip(ga, (gb[1], gb[2], gb[0]), strict=True):
        torch.testing.assert_close(mine, other, atol=1e-12, rtol=0)
    assert_vjp_is_the_derivative(scene)


def test_opaque_composition_shows_object_or_scene_whichever_is_nearer():
    visible, hidden = cloud(1.2, 0.15, 60.0), cloud(3.0, -0.3, 60.0)
    scene = surrogate([visible, hidden], opaque=True)
    theta = torch.full(scene.theta_shape, 4.0, dtype=torch.float64)
    poses = scene.camera_poses(STATES)
    images = scene.render(poses, theta).images
    changed = (images - 0.4).abs().amax(1) > 1e-9
    assert changed.any()
    white = squash(torch.tensor(4.0).double())
    shown = images.permute(0, 2, 3, 1)[changed]
    assert (shown > 0.41).all(), "no pixel is a blend with the scene: it would lie between"
    assert (shown <= white + 1e-9).all()
    alone = surrogate([visible], opaque=True)
    torch.testing.assert_close(alone.render(poses, theta[: visible.parameter_count]).images, images)
    rgb, depth_m = wall(poses, PINHOLE)
    torch.testing.assert_close(scene.overlay(rgb, depth_m, poses, theta), images)
    assert torch.equal(
        scene.overlay(rgb, torch.full_like(depth_m, 0.1), poses, theta), rgb.permute(0, 3, 1, 2)
    )
    with pytest.raises(ValueError, match="expected a background of shapes"):
        scene.overlay(rgb[:1], depth_m, poses, theta)


def test_summed_levels_are_trilinear_grids_added_before_the_squash():
    field = with_summed_levels(cloud(1.2, 0.0), levels=3, coarsest=2, finest=8)
    sizes = (2, 4, 8)
    assert field.theta_shape == (sum(n**3 for n in sizes), 3)
    theta = torch.randn(field.theta_shape, dtype=torch.float64)
    total, first = 0.0, 0
    for n in sizes:
        grid = theta[first : first + n**3].reshape(n, n, n, 3).permute(3, 0, 1, 2)[None]
        total = (
            total
            + torch.nn.functional.interpolate(grid, size=(8, 8, 8), mode="trilinear", align_corners=False)[0]
        )
        first += n**3
    values = total.permute(1, 2, 3, 0).reshape(-1, 3)
    colours = field.colours(theta)[:-1]
    # Rows that one voxel shows are that voxel's value.
    torch.testing.assert_close(colours[:-1], squash(values[: len(colours) - 1]), atol=1e-10, rtol=0)
    assert_vjp_is_the_derivative(surrogate([field, cloud(1.6, 0.2)]))


def test_summed_levels_begin_at_the_plain_colours():
    colours = np.random.default_rng(0).uniform(0.2, 0.8, (492, 3))
    plain = dataclasses.replace(cloud(1.2, 0.0), plain_colours=colours)
    field = with_summed_levels(plain, levels=3, coarsest=2, finest=8)
    got = field.colours(torch.tensor(field.plain_theta))[:-1]
    np.testing.assert_allclose(got, colours, atol=2e-3)
    with pytest.raises(ValueError, match="expected at least one level"):
        with_summed_levels(plain, levels=0)


def test_seen_rows_are_the_rows_of_the_whole():
    field = cloud(1.2, 0.0)
    rows = np.array([3, 77, 400, 492])
    seen = SeenRows(field, rows)
    theta = torch.randn(field.theta_shape, dtype=torch.float64, requires_grad=True)
    values = seen.values(theta)
    expected = field.colours(theta)[torch.from_numpy(rows)]
    torch.testing.assert_close(seen.colours(values), expected.detach())
    probe = torch.randn(4, 3, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(expected, theta, probe)
    torch.testing.assert_close(seen.gradient(values, probe), gradient)
