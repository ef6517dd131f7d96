"""The surrogate in plain torch, on the CPU and on a GPU, against the processor's kernels."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.on_device import sensor_on
from advnerf_core.errors import DeviceError
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object
from advnerf_core.geometry import Pinhole, camera_mount, make_transform, rotation_z
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.bake import bake
from advnerf_core.scene.colour import ColourMap
from advnerf_core.scene.device_surrogate import DeviceSurrogate, background_on
from advnerf_core.scene.field import SceneField
from advnerf_core.scene.many_textures import ManyTextures
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate
from advnerf_core.scene.train import Trainer
from tests.advnerf_core.scene.test_scene_field import FIELD, TRAIN
from tests.support.colour_room import CAMERA, room_images, room_poses
from tests.support.devices import DEVICES


@pytest.fixture(params=DEVICES)
def device(request):
    return request.param


PINHOLE = Pinhole(20, 12, 13.0, 13.0, 10.0, 5.0)
HIGH, WIDE = PINHOLE.height, PINHOLE.width
MOUNT = camera_mount(0.3, 0.0, 0.2, 0.17)
STATES = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.1, 0.15]], dtype=torch.float64)


def wall(poses, pinhole):
    """A wall with a step in its depth, and a corner of which nothing is known."""
    rows = torch.linspace(0.2, 0.7, pinhole.height, dtype=torch.float64)[None, :, None, None]
    rgb = rows.expand(len(poses), pinhole.height, pinhole.width, 3).clone()
    depth_m = torch.full(rgb.shape[:3], 5.0, dtype=torch.float64)
    depth_m[:, :, : 2 * WIDE // 5] = 1.9
    depth_m[:, : HIGH // 3, : WIDE // 5] = torch.nan
    return rgb, depth_m


def cloud(x_m, y_m, density=6.0, seed=0):
    """A fog of blobs with holes in it; some of its colours are fixed, and its density falls below zero."""
    slots = np.random.default_rng(seed).permutation(512).astype(np.int32).reshape(8, 8, 8)
    i, j, k = np.indices((8, 8, 8))
    inside = 10.0 - (i - 3.5) ** 2 - (j - 3.5) ** 2 - (k - 3.5) ** 2
    return VoxelGridObject(
        slots,
        (492, 3),
        np.tile([[0.1, 0.2, 0.3]], (20, 1)),
        -0.3 * np.ones(3),
        0.3 * np.ones(3),
        make_transform(rotation_z(x_m), [x_m, y_m, 0.2]),
        density=np.where(inside > -8.0, 0.1 * density * inside, -1.0),
        step_units=0.05,
    )


def face(x_m=2.0, y_m=0.0):
    return cube_face_object(0.8, 4, (0.2, 0.5, 0.3), make_transform(rotation_z(np.pi), [x_m, y_m, 0.4]))


TINTED = ColourMap(((0.8, 0.1, 0.0), (0.0, 0.9, 0.1), (0.1, 0.0, 0.7)), (0.02, 0.0, 0.05), 1.2)
SCENES = {
    "a face": lambda: [face()],
    "a cloud": lambda: [cloud(1.6, 0.1)],
    "mixed colours": lambda: [with_summed_levels(cloud(1.6, 0.1), levels=2)],
    "one before the other, all before and behind the wall": lambda: [cloud(2.2, 0.2), face(), cloud(1.5, 0.0, 2.0, 1), cloud(1.5, 0.0, 2.0, 1)],
}  # fmt: skip


def surrogate(objects, background=wall, dtype=torch.float64, **options):
    return Surrogate(background, PINHOLE, MOUNT, objects, dtype=dtype, **options)


def noise(shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize(
    ("scene", "dtype", "close"),
    [*((scene, torch.float64, 1e-11) for scene in SCENES), (list(SCENES)[-1], torch.float32, 2e-6)],
)
def test_images_and_gradients_are_those_of_the_processor(scene, dtype, close, device):
    here = surrogate(SCENES[scene](), dtype=dtype)
    there, poses = DeviceSurrogate(here, device), here.camera_poses(STATES)
    theta, slopes = noise(here.theta_shape, dtype=dtype), noise((2, 3, HIGH, WIDE), 1, dtype)
    ours, theirs = here.render(poses, theta), there.render(poses, theta)
    assert float((ours.images - here.render(poses, theta + 1.0).images).abs().max()) > 0.05  # it is seen
    torch.testing.assert_close(theirs.images.cpu(), ours.images, atol=close, rtol=0)
    wanted, found = ours.vjp(slopes), theirs.vjp(slopes.to(there.device))
    assert found.device == theta.device
    torch.testing.assert_close(found, wanted, atol=close * float(wanted.abs().max()) * 10, rtol=0)
    assert torch.equal(found, theirs.vjp(slopes.to(there.device)))  # whatever the order of the threads


def test_the_gradient_is_that_of_finite_differences(device):
    there = DeviceSurrogate(surrogate([cloud(1.6, 0.1), face()]), device)
    theta, direction, slopes = (
        noise(there.theta_shape),
        noise(there.theta_shape, 1),
        noise((2, 3, HIGH, WIDE), 2),
    )
    poses, h = there.camera_poses(STATES), 1e-5
    gradient = there.render(poses, theta).vjp(slopes.to(there.device))
    plus, minus = (there.render(poses, theta + sign * h * direction).images.cpu() for sign in (1, -1))
    torch.testing.assert_close(
        (gradient * direction).sum(), ((plus - minus) * slopes).sum() / (2 * h), rtol=1e-7, atol=1e-9
    )


def test_several_textures_are_shown_at_once(device):
    here = surrogate([cloud(1.6, 0.1), face()])
    many, there = ManyTextures(here, 2, 1), DeviceSurrogate(here, device).many(2, 1)
    assert there.theta_shape == many.theta_shape
    drawn, again = (each.initial_theta(torch.Generator().manual_seed(3)) for each in (many, there))
    assert torch.equal(drawn, again)
    poses, slopes = here.camera_poses(STATES.repeat(2, 1)), noise((4, 3, HIGH, WIDE), 1)
    ours, theirs = many.render(poses, drawn), there.render(poses, drawn)
    torch.testing.assert_close(theirs.images.cpu(), ours.images, atol=1e-11, rtol=0)
    torch.testing.assert_close(theirs.vjp(slopes.to(there.device)), ours.vjp(slopes), atol=1e-9, rtol=0)
    with pytest.raises(ValueError, match=r"expected poses in multiples of 2, got 3"):
        there.render(poses[:3], drawn)


def test_frames_serve_other_textures_and_a_theta_that_changed_in_place(device):
    here = surrogate([face()])
    there, poses = DeviceSurrogate(here, device), here.camera_poses(STATES)
    frames, theta = there.prepare(poses), noise(here.theta_shape)
    before = frames.render(theta).images
    theta += 1.0
    torch.testing.assert_close(
        frames.render(theta).images.cpu(), here.render(poses, theta).images, atol=1e-11, rtol=0
    )
    theta -= 1.0
    torch.testing.assert_close(frames.render(theta).images, before, atol=1e-12, rtol=0)


def test_slopes_that_are_not_finite_make_the_gradient_so(device):
    there = DeviceSurrogate(surrogate([face()]), device)
    rendered = there.render(there.camera_poses(STATES), noise(there.theta_shape))
    slopes = torch.zeros(2, 3, HIGH, WIDE, dtype=torch.float64, device=there.device)
    assert not rendered.vjp(slopes).any()
    slopes[1, 2, HIGH // 2, WIDE // 2] = torch.inf
    assert torch.isnan(rendered.vjp(slopes)).all()


def test_a_scene_without_objects_is_its_background(device):
    here = surrogate(None)
    there, poses = DeviceSurrogate(here, device), here.camera_poses(STATES)
    rendered = there.render(poses, None)
    assert torch.equal(rendered.images.cpu(), here.render(poses, None).images)
    assert rendered.vjp(rendered.images).shape == (0, 3)


@pytest.fixture(scope="module")
def learned():
    trained = Trainer(room_images(), FIELD, TRAIN).run()
    return FieldRenderer(trained.scene, trained.occupied, trained.march)


@pytest.mark.slow  # trains; `test_agreement` has random voxels
def test_a_baked_scene_is_drawn_as_on_the_processor(device, learned):
    poses = room_poses(2, seed=5)
    baked = bake(learned, room_poses(60, seed=8), CAMERA, 0.7)
    assert (baked.voxels.brick_of >= 0).any()
    assert (baked.voxels.brick_of < 0).any()
    check_background(device, baked, poses)
    objects = [
        cube_face_object(
            0.4, 4, T_world_from_object=make_transform(rotation_z(0.3), [0.0, 0.0, 0.0]), one_sided=False
        )
    ]
    here = Surrogate(baked, PINHOLE, np.eye(4), objects)
    images = DeviceSurrogate(here, device).render(poses, here.plain_theta()).images.cpu()
    assert float((images - here.render(poses, here.plain_theta()).images).abs().mean()) < 1e-5


@pytest.mark.slow
def test_a_field_is_rendered_as_on_the_processor(device, learned):
    check_background(device, learned, room_poses(2, seed=5))


@pytest.mark.parametrize(
    ("side_m", "changes", "colour_map"),
    [(2.0, {"learned_background": False}, TINTED), (4000.0, {"direction_bands": 3}, None)],
    ids=["transparent, mapped colours", "glossy, of a large unit"],
)
def test_fields_of_all_kinds_are_rendered_as_on_the_processor(device, side_m, changes, colour_map):
    config = dataclasses.replace(FIELD, box_low_m=(-side_m / 2,) * 3, box_high_m=(side_m / 2,) * 3, **changes)
    scene, generator = SceneField(config), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in scene.parameters():
            parameter.normal_(0.0, 0.3, generator=generator)
    occupied = np.random.default_rng(0).random((16, 16, 16)) > 0.4
    march = MarchConfig(*(side_m * each for each in (0.05, 0.01, 0.03)), max_samples=128)
    here = FieldRenderer(scene, occupied, march, colour_map, behind=(0.2, 0.4, 0.9))
    poses = room_poses(2, seed=5)
    poses[:, :3, 3] *= side_m / 10.0
    check_background(device, here, poses)


def test_a_contracted_field_stays_on_the_processor(device):
    config = dataclasses.replace(FIELD, contraction=True)
    here = FieldRenderer(SceneField(config), np.ones((16, 16, 16), np.bool_), MarchConfig())
    baked = bake(here, np.zeros((0, 4, 4)), PINHOLE)
    assert [background_on(device, each) for each in (here, baked)] == [here, baked]


def check_background(device, here, poses):
    rgb, depth_m, _ = here.render(poses, PINHOLE)
    theirs, their_depth_m = (each.cpu() for each in background_on(device, here)(poses, PINHOLE)[:2])
    difference = (theirs - rgb).abs()
    # A sample on the edge of a cell may fall to either side.
    assert float((difference > 1e-4).double().mean()) < 0.01
    assert float(difference.mean()) < 1e-5
    same = torch.isfinite(depth_m) & torch.isfinite(their_depth_m)
    assert float(same.double().mean()) > 0.5
    assert float((their_depth_m - depth_m)[same].abs().median()) < 1e-5 * here.config.ray_unit_m


def test_what_a_gpu_cannot_show_is_refused(device):
    with pytest.raises(DeviceError, match="blends"):
        DeviceSurrogate(surrogate([face()], opaque=True), device)
    with pytest.raises(DeviceError, match="the sensor ManyTextures"):
        sensor_on(ManyTextures(surrogate([face()]), 2, 1), device)
    with pytest.raises(ValueError, match=r"expected theta \[4, 4, 3\], got \[3, 3, 3\]"):
        DeviceSurrogate(surrogate([face()]), device).sense(STATES, torch.zeros(3, 3, 3))
    with pytest.raises(ValueError, match=r"expected theta for 1 object\(s\), got None"):
        DeviceSurrogate(surrogate([face()]), device).sense(STATES, None)
