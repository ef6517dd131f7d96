"""Images with alpha: gradients before random colours, and a hazy ball whose opacity is known in closed form."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from advnerf_core.data.views import ImageSet
from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, Pinhole, look_at
from advnerf_core.render.march import MarchConfig, Samples
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.torch_step import TorchStep, render_rays
from advnerf_core.scene.train import TrainConfig, TrainedScene, Trainer, train_scene
from advnerf_core.scene.train_step import CpuStep, Matte
from tests.support.fields import random_field, random_samples

GRID = HashGridConfig(levels=6, features=4, log2_entries=12, coarsest=8, finest=64)
FIELD = SceneFieldConfig(
    (-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), GRID, hidden=16, features=7, learned_background=False
)
CAMERA = Pinhole(32, 32, 40.0, 40.0, 16.0, 16.0)
RADIUS_M, DENSITY_PER_M = 0.5, 3.0
TRAIN = TrainConfig(
    steps=250,
    samples_per_step=1 << 13,
    max_rays=1024,
    occupancy_resolution=32,
    warmup_steps=40,
    distortion=0.0,
    march=MarchConfig(
        near_m=0.5, smallest_step_m=0.02, largest_step_m=0.04, step_growth=0.01, max_samples=128
    ),
)


def some_batch(rays: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.uint8], Samples, Matte]:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 20, rays)
    counts[[0, -1]] = 0
    samples = random_samples(rng, counts)
    matte = Matte(rng.integers(0, 256, rays).astype(np.uint8), rng.random((rays, 3), dtype=np.float32))
    lines = rng.normal(size=(rays, 6)).astype(np.float32)
    return lines, rng.integers(0, 256, (rays, 3)).astype(np.uint8), samples, matte


def test_both_steppers_give_the_gradient_of_the_definition() -> None:
    rays, targets, samples, matte = some_batch(300, 0)
    kernels, plain, scene = (
        CpuStep(random_field(FIELD, 1), 0.1),
        TorchStep(random_field(FIELD, 1), 0.1),
        random_field(FIELD, 1),
    )
    packed, encoded = kernels.visible(samples, least_weight=0.0)
    first, second = (
        kernels.gradients(rays, targets, packed, encoded, matte),
        plain.gradients(rays, targets, packed, matte),
    )
    colours, _, alpha = render_rays(scene, torch.from_numpy(rays), packed)
    opacity, behind = torch.from_numpy(matte.opacities)[:, None] / 255.0, torch.from_numpy(matte.behind)
    shown = alpha[:, None] * colours + (1.0 - alpha[:, None]) * behind
    real = opacity * torch.from_numpy(targets) / 255.0 + (1.0 - opacity) * behind
    loss = torch.nn.functional.huber_loss(shown, real, delta=0.1)
    loss.backward()
    assert first.loss == pytest.approx(loss.item(), rel=1e-5)
    assert second.loss == pytest.approx(loss.item(), rel=1e-6)
    assert first.mse == pytest.approx(((shown - real) ** 2).mean().item(), rel=1e-5)
    for name, parameter in scene.named_parameters():
        if name == "background":
            assert parameter.grad is None
            assert not kernels.grads[name].any()
            assert not plain.grads[name].any()
            continue
        assert parameter.grad is not None
        scale = parameter.grad.abs().max().item()
        np.testing.assert_allclose(kernels.grads[name], parameter.grad, atol=3e-5 * scale, err_msg=name)
        np.testing.assert_allclose(plain.grads[name], parameter.grad, atol=1e-6 * scale, err_msg=name)
    kernels.update(0, 1e-2)
    plain.update(0, 1e-2)
    assert not kernels.values["background"].any()
    assert not plain.values["background"].any()


def test_the_loss_vanishes_only_at_the_true_opacity() -> None:
    """Colours right everywhere: what is left is the opacity, by ``(opacity - alpha)^2`` times the spread of the colours behind."""
    rays, _, samples, matte = some_batch(4000, 2)
    scene = random_field(FIELD, 3)
    with torch.no_grad():
        colours, _, alpha = render_rays(scene, torch.from_numpy(rays), samples)
    exact = np.rint(255 * colours.numpy()).astype(np.uint8)
    right = Matte(np.rint(255 * alpha.numpy()).astype(np.uint8), matte.behind)
    wrong = dataclasses.replace(
        right, opacities=np.minimum(right.opacities.astype(int) + 40, 255).astype(np.uint8)
    )
    step = CpuStep(scene, huber=10.0)
    losses = []
    for opacities in (right, wrong):
        packed, encoded = step.visible(samples, least_weight=0.0)
        losses.append(step.gradients(rays, exact, packed, encoded, opacities).mse)
    assert losses[0] < 1e-5
    off = (wrong.opacities - alpha.numpy() * 255)[:, None] / 255 * (exact / 255 - matte.behind)
    assert losses[1] == pytest.approx(float(np.mean(off**2)), rel=0.02)


def hazy_ball(T: Array) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Colours and opacity of a ball of constant density: ``1 - exp(-density * chord)``. Colours outside mean nothing."""
    o, d = T[:3, 3], CAMERA.directions() @ T[:3, :3].T
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ o
    chord = 2.0 * np.sqrt(np.maximum(b * b - o @ o + RADIUS_M**2, 0.0))
    rgb = np.broadcast_to([0.9, 0.4, 0.1], (*chord.shape, 3)) * (chord > 0.0)[..., None]
    return np.rint(255 * rgb).astype(np.uint8), 1.0 - np.exp(-DENSITY_PER_M * chord)


def ball_poses(count: int, seed: int) -> Array:
    eyes = np.random.default_rng(seed).normal(size=(count, 3))
    eyes *= 1.8 / np.linalg.norm(eyes, axis=1, keepdims=True)
    return np.stack([look_at(eye, [0.0, 0.0, 0.0]) for eye in eyes])


def ball_images(count: int = 40) -> ImageSet:
    poses = ball_poses(count, 0)
    views = [hazy_ball(T) for T in poses]
    alpha = np.rint(255 * np.stack([v[1] for v in views])).astype(np.uint8)
    return ImageSet(np.stack([v[0] for v in views]), (CAMERA,) * count, poses, alpha)


@pytest.fixture(scope="module")
def trained() -> TrainedScene:
    return train_scene(ball_images(), FIELD, dataclasses.replace(TRAIN, backend="numba"))


def check_opacity(trained: TrainedScene) -> None:
    poses = ball_poses(4, 1)
    renderer = FieldRenderer(trained.scene, trained.occupied, trained.march, least_transmittance=1e-4)
    rgb, _, alpha = renderer.render(poses, CAMERA)
    views = [hazy_ball(T) for T in poses]
    truth = np.stack([v[1] for v in views])
    error = np.abs(alpha.numpy() - truth)
    assert error.mean() < 0.015
    assert alpha.numpy()[truth == 0.0].mean() < 0.01, "what is empty is transparent"
    over_white = truth[..., None] * np.stack([v[0] for v in views]) / 255.0 + (1.0 - truth[..., None])
    assert np.abs(rgb.numpy() - over_white).mean() < 0.02
    over_black = FieldRenderer(trained.scene, trained.occupied, trained.march, None, 1e-4, (0.0, 0.0, 0.0))
    difference = rgb - over_black.render(poses, CAMERA)[0]
    torch.testing.assert_close(difference, (1.0 - alpha)[..., None].expand_as(rgb), atol=1e-5, rtol=0)


@pytest.mark.slow
def test_opacity_comes_out_as_in_its_closed_form(trained: TrainedScene) -> None:
    check_opacity(trained)


@pytest.mark.slow
def test_opacity_comes_out_as_in_its_closed_form_in_torch() -> None:
    check_opacity(train_scene(ball_images(), FIELD, dataclasses.replace(TRAIN, backend="torch")))


def test_steps_are_the_same_each_time_and_behind_differs_between_them(trained: TrainedScene) -> None:
    images = ball_images(4)
    short = dataclasses.replace(TRAIN, steps=3, backend="numba")
    first, again = (train_scene(images, FIELD, short).scene.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    trainer = Trainer(images, FIELD, short)
    behind = []
    for _ in range(2):
        matte = trainer._matte(np.arange(5), np.arange(5), np.random.default_rng(trainer.step))
        assert matte is not None
        behind.append(matte.behind)
        with torch.no_grad():
            trainer.train_step()
    assert not np.array_equal(behind[0], behind[1])


def test_opaque_images_need_a_background_to_learn() -> None:
    images = ball_images(2)
    with pytest.raises(AdvnerfError, match="images with alpha"):
        Trainer(ImageSet(images.rgb, images.pinholes, images.T_world_from_camera), FIELD, TRAIN)
