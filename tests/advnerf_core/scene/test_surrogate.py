import numpy as np
import pytest
import torch

from advnerf_core.fields.voxel_grid import cube_face_object, squash
from advnerf_core.geometry import Pinhole, camera_mount, make_transform, rotation_z
from advnerf_core.scene.surrogate import Surrogate
from tests.support.layers import composite

PINHOLE = Pinhole(40, 26, 25.0, 25.0, 20.0, 11.0)
MOUNT = camera_mount(0.3, 0.0, 0.2, 0.17)


def wall(poses, pinhole, depth_m=5.0):
    """A background of one colour gradient at constant depth."""
    rows = torch.linspace(0.2, 0.7, pinhole.height, dtype=torch.float64)[None, :, None, None]
    rgb = rows.expand(len(poses), pinhole.height, pinhole.width, 3).clone()
    return rgb, torch.full(rgb.shape[:3], depth_m, dtype=torch.float64)


def face(x_m, resolution=4, y_m=0.0):
    return cube_face_object(
        0.8, resolution, (0.2, 0.5, 0.3), make_transform(rotation_z(np.pi), [x_m, y_m, 0.4])
    )


def surrogate(objects, background=wall, **options):
    return Surrogate(background, PINHOLE, MOUNT, objects, dtype=torch.float64, **options)


STATES = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.1, 0.15]], dtype=torch.float64)


def test_vjp_equals_finite_differences_and_a_linear_probe():
    scene = surrogate(face(2.0))
    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(scene.theta_shape, dtype=torch.float64, generator=generator)
    poses = scene.camera_poses(STATES)
    probe = torch.randn(2, 3, 26, 40, dtype=torch.float64, generator=generator)
    gradient = scene.render(poses, theta).vjp(probe)
    direction = torch.randn(theta.shape, dtype=torch.float64, generator=generator)
    h = 1e-5
    plus, minus = (scene.render(poses, theta + s * h * direction).images for s in (1, -1))
    difference = ((plus - minus) * probe).sum() / (2 * h)
    torch.testing.assert_close((gradient * direction).sum(), difference, rtol=1e-8, atol=0)


def test_images_are_the_composition_of_object_and_background():
    scene = surrogate(face(2.0))
    theta = torch.randn(scene.theta_shape, dtype=torch.float64)
    poses = scene.camera_poses(STATES)
    empty = surrogate(None).render(poses, None).images
    image = scene.render(poses, theta).images
    black, white = (
        scene.render(poses, torch.full(scene.theta_shape, v, dtype=torch.float64)).images for v in (-60, 60)
    )
    alpha = (white - black)[:, 0]
    seen = squash(theta)
    inside = alpha > 0.999
    assert inside.sum() > 30
    covered = image.permute(0, 2, 3, 1)[inside]
    assert (covered <= seen.amax((0, 1)) + 1e-9).all()
    assert (covered >= seen.amin((0, 1)) - 1e-9).all()
    torch.testing.assert_close(image.permute(0, 2, 3, 1)[alpha == 0], empty.permute(0, 2, 3, 1)[alpha == 0])
    torch.testing.assert_close(black, empty * (1 - alpha)[:, None], atol=1e-12, rtol=0)


@pytest.mark.parametrize(("wall_m", "visible"), [(1.0, False), (1.62, True), (5.0, True)])
def test_nearer_scene_hides_the_object_beyond_the_tolerance(wall_m, visible):
    # The face is at planar depth 1.7 or so.
    scene = surrogate(face(2.0), lambda poses, pinhole: wall(poses, pinhole, wall_m))
    theta = torch.zeros(scene.theta_shape, dtype=torch.float64)
    rendered = scene.render(scene.camera_poses(STATES[:1]), theta)
    assert bool((rendered.vjp(torch.ones_like(rendered.images)).abs() > 0).any()) == visible
    background = surrogate(None).render(scene.camera_poses(STATES[:1]), None).images
    assert torch.equal(rendered.images, background) != visible


def test_two_objects_keep_their_order_and_their_gradients_apart():
    near, far = face(1.5, 3, y_m=-0.2), face(2.5, 2, y_m=0.2)
    both = surrogate([far, near])
    assert both.theta_shape == (4 + 9, 3)
    theta = torch.randn(13, 3, dtype=torch.float64)
    poses = both.camera_poses(STATES)
    single = [
        surrogate(o).render(poses, t)
        for o, t in ((far, theta[:4].reshape(2, 2, 3)), (near, theta[4:].reshape(3, 3, 3)))
    ]
    empty = surrogate(None).render(poses, None).images
    alphas = []
    for o, n in ((far, 2), (near, 3)):
        white, black = (
            surrogate(o).render(poses, torch.full((n, n, 3), v, dtype=torch.float64)).images
            for v in (60, -60)
        )
        alphas.append((white - black)[:, 0])
    alpha = torch.stack([*alphas, torch.ones_like(alphas[0])])
    premultiplied = torch.stack(
        [*(s.images - empty * (1 - a)[:, None] for s, a in zip(single, alphas, strict=True)), empty]
    )
    depth = torch.stack([torch.full_like(alpha[0], d) for d in (2.2, 1.2, 5.0)])
    expected, _, _ = composite(premultiplied.permute(0, 1, 3, 4, 2), alpha, depth)
    rendered = both.render(poses, theta)
    torch.testing.assert_close(rendered.images.permute(0, 2, 3, 1), expected, atol=1e-12, rtol=0)
    gradient = rendered.vjp(torch.ones_like(rendered.images))
    torch.testing.assert_close(gradient[4:], single[1].vjp(torch.ones_like(rendered.images)).reshape(9, 3))
    assert (
        gradient[:4].abs() <= single[0].vjp(torch.ones_like(rendered.images)).reshape(4, 3).abs() + 1e-12
    ).all()


def test_frames_can_be_rendered_again_without_the_scene():
    calls = []

    def counting(poses, pinhole):
        calls.append(len(poses))
        return wall(poses, pinhole)

    scene = surrogate(face(2.0), counting)
    frames = scene.prepare(scene.camera_poses(STATES))
    thetas = [torch.randn(scene.theta_shape, dtype=torch.float64) for _ in range(3)]
    images = [frames.render(theta) for theta in thetas]
    for theta, rendered in zip(thetas, images, strict=True):
        rendered.vjp(torch.ones_like(rendered.images))
        assert torch.equal(rendered.images, scene.render(scene.camera_poses(STATES), theta).images)
    assert calls == [2, 2, 2, 2]


def test_float32_agrees_with_float64():
    scene64, scene32 = surrogate(face(2.0)), Surrogate(wall, PINHOLE, MOUNT, face(2.0))
    theta = torch.randn(scene64.theta_shape, dtype=torch.float64)
    a = scene64.observe(theta)(STATES)
    b = scene32.observe(theta.float())(STATES.float())
    assert b.dtype == torch.float32
    torch.testing.assert_close(a.float(), b, atol=2e-6, rtol=0)


def test_initial_theta_is_white_noise_that_differs_by_seed():
    scene = surrogate(face(2.0))
    torch.testing.assert_close(
        squash(scene.plain_theta()), torch.tensor([0.2, 0.5, 0.3]).double().expand(4, 4, 3)
    )
    a, b, again = (scene.initial_theta(torch.Generator().manual_seed(s)) for s in (0, 1, 0))
    assert torch.equal(a, again)
    assert not torch.equal(a, b)
    assert 0.75 < a.std() < 1.25  # 48 numbers of N(0, 1)
    assert abs(a.mean()) < 0.5
    empty = surrogate(None)
    assert empty.initial_theta(torch.Generator()).shape == (0, 3)
    for theta in (None, torch.zeros(0, 3)):
        rendered = empty.render(empty.camera_poses(STATES), theta)
        assert rendered.vjp(rendered.images).shape == (0, 3)


def test_wrong_backgrounds_and_missing_theta_are_refused():
    bad = surrogate(face(2.0), lambda poses, pinhole: (torch.zeros(1, 2, 2, 3), torch.zeros(1, 2, 2)))
    with pytest.raises(ValueError, match="expected a background of shapes"):
        bad.render(bad.camera_poses(STATES), torch.zeros(bad.theta_shape))
    with pytest.raises(ValueError, match="expected theta for 1 object"):
        surrogate(face(2.0)).render(np.eye(4)[None], None)
