"""Gains of photographs: their gradient against finite differences, and known gains recovered with the scene."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array
from advnerf_core.render.march import MarchConfig, Samples
from advnerf_core.scene.exposure import Exposures, RayGains
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.torch_step import TorchStep, render_rays
from advnerf_core.scene.train import CheckpointError, TrainConfig, TrainedScene, Trainer
from advnerf_core.scene.train_step import CpuStep, Matte
from tests.support.colour_room import CAMERA, room_images, room_poses, room_view
from tests.support.fields import random_field, random_samples

GRID = HashGridConfig(levels=6, features=4, log2_entries=12, coarsest=8, finest=96)
FIELD = SceneFieldConfig((-1.05, -1.05, -0.55), (1.05, 1.05, 0.55), grid=GRID, hidden=16, features=7)
MARCH = MarchConfig(near_m=0.05, smallest_step_m=0.01, largest_step_m=0.05, step_growth=0.02, max_samples=128)
TRAIN = TrainConfig(
    steps=400,
    samples_per_step=1 << 13,
    max_rays=1024,
    occupancy_resolution=32,
    warmup_steps=60,
    march=MARCH,
    exposure=True,
)


def some_batch(rays: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.uint8], Samples, RayGains]:
    rng = np.random.default_rng(seed)
    samples = random_samples(rng, rng.integers(0, 20, rays))
    targets = rng.integers(0, 256, (rays, 3)).astype(np.uint8)
    targets[::5] = 255  # cut off by the camera
    gains = np.exp(rng.normal(0.0, 0.5, (rays, 3))).astype(np.float32)
    exposure = RayGains(np.zeros(rays, np.int64), gains, np.zeros_like(gains))
    return rng.normal(size=(rays, 6)).astype(np.float32), targets, samples, exposure


def some_matte(rays: int, seed: int) -> Matte:
    rng = np.random.default_rng(seed)
    return Matte(rng.integers(0, 256, rays).astype(np.uint8), rng.random((rays, 3), dtype=np.float32))


def loss_of_each(
    scene: SceneField,
    rays: NDArray[np.float32],
    targets: NDArray[np.uint8],
    samples: Samples,
    logs: Array,
    matte: Matte | None,
) -> Array:
    """The definition, in double precision: part of each ray and channel ``[R, 3]`` in the mean Huber loss."""
    with torch.no_grad():
        colours, _, alpha = render_rays(scene, torch.from_numpy(rays), samples)
    shown, real = np.exp(logs) * colours.double().numpy(), targets / 255.0
    shown = np.where(targets == 255, np.minimum(shown, 1.0), shown)
    if matte is not None:
        cover, opacity = alpha.double().numpy()[:, None], matte.opacities[:, None] / 255.0
        shown = cover * shown + (1.0 - cover) * matte.behind
        real = opacity * real + (1.0 - opacity) * matte.behind
    size = np.abs(shown - real)
    loss: Array = np.where(size <= 0.1, 0.5 * size**2, 0.1 * (size - 0.05)) / size.size
    return loss


@pytest.mark.parametrize("transparent", [False, True])
def test_gradients_of_the_gains_are_those_of_finite_differences(transparent: bool) -> None:
    field = dataclasses.replace(FIELD, learned_background=not transparent)
    rays, targets, samples, exposure = some_batch(300, 0)
    matte = some_matte(300, 1) if transparent else None
    kernels, plain = CpuStep(random_field(field, 1), 0.1), TorchStep(random_field(field, 1), 0.1)
    packed, encoded = kernels.visible(samples, least_weight=0.0)
    first = kernels.gradients(rays, targets, packed, encoded, matte, exposure)
    of_kernels = exposure.grad_log.copy()
    second = plain.gradients(rays, targets, packed, matte, exposure)

    logs = np.log(exposure.gains.astype(np.float64))
    step = 1e-6
    around = [
        loss_of_each(random_field(field, 1), rays, targets, packed, logs + s, matte) for s in (step, -step)
    ]
    expected = (around[0] - around[1]) / (2.0 * step)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(of_kernels, expected, atol=1e-4 * scale)
    np.testing.assert_allclose(exposure.grad_log, expected, atol=1e-4 * scale)
    whole = loss_of_each(random_field(field, 1), rays, targets, packed, logs, matte).sum()
    assert first.loss == pytest.approx(whole, rel=1e-5)
    assert second.loss == pytest.approx(whole, rel=1e-5)
    for name, gradient in plain.grads.items():
        size = float(gradient.abs().max())
        np.testing.assert_allclose(kernels.grads[name], gradient, atol=5e-5 * size, err_msg=name)


def test_gains_of_one_change_nothing() -> None:
    rays, targets, samples, exposure = some_batch(300, 2)
    exposure.gains[...] = 1.0
    with_gains, without = CpuStep(random_field(FIELD, 3)), CpuStep(random_field(FIELD, 3))
    assert with_gains.step(rays, targets, samples, None, exposure).loss == pytest.approx(
        without.step(rays, targets, samples).loss, rel=1e-6
    )
    for name, gradient in without.grads.items():
        size = float(np.abs(gradient).max())
        np.testing.assert_allclose(with_gains.grads[name], gradient, atol=1e-5 * size, err_msg=name)


def test_the_mean_exposure_stays_and_photographs_without_rays_keep_theirs() -> None:
    exposures = Exposures(4)
    for step in range(20):
        rays = exposures.of(np.array([0, 0, 1, 1]))
        rays.grad_log[:2], rays.grad_log[2:] = 0.1, -0.1
        exposures.update(rays, step, 1e-2)
    np.testing.assert_allclose(exposures.logs.mean(axis=0), 0.0, atol=1e-6)
    assert (exposures.logs[0] < -0.1).all()
    assert (exposures.logs[1] > 0.1).all()
    np.testing.assert_array_equal(exposures.logs[2], exposures.logs[3])


def unevenly_exposed(images: ImageSet) -> tuple[ImageSet, Array]:
    """Pictures as a camera takes them that chooses exposure and white balance anew for each, and the logarithms of the gains."""
    logs = np.random.default_rng(5).normal(0.0, 0.2, (len(images.rgb), 3))
    logs -= logs.mean(axis=0)
    bright = np.clip(np.rint(images.rgb * np.exp(logs)[:, None, None]), 0, 255)
    return dataclasses.replace(images, rgb=bright.astype(np.uint8)), logs


def held_out_db(trained: TrainedScene) -> float:
    poses = room_poses(8, seed=1)
    rgb = FieldRenderer(trained.scene, trained.occupied, trained.march).render(poses, CAMERA)[0].numpy()
    return psnr(rgb, np.stack([room_view(T)[0] for T in poses]) / 255.0)


def test_known_gains_are_recovered_and_held_out_views_are_better() -> None:
    images, logs = unevenly_exposed(room_images())
    without = Trainer(images, FIELD, dataclasses.replace(TRAIN, exposure=False)).run()
    trained = Trainer(images, FIELD, TRAIN).run()
    assert without.gains is None
    assert trained.gains is not None
    error = np.log(trained.gains) - logs
    np.testing.assert_allclose(np.log(trained.gains).mean(axis=0), 0.0, atol=1e-5)
    assert np.sqrt(np.mean(error**2)) < 0.05  # of 0.2
    assert held_out_db(trained) > held_out_db(without) + 3.0


@pytest.mark.slow
def test_photographs_of_one_exposure_get_gains_of_one() -> None:
    trained = Trainer(room_images(), FIELD, TRAIN).run()
    assert trained.gains is not None
    assert np.sqrt(np.mean(np.log(trained.gains) ** 2)) < 0.03


def test_a_killed_training_goes_on_with_its_gains(tmp_path: Path) -> None:
    images, _ = unevenly_exposed(room_images(6))
    path, short = tmp_path / "checkpoint.safetensors", dataclasses.replace(TRAIN, steps=40)
    whole = Trainer(images, FIELD, short).run()
    half = Trainer(images, FIELD, short)
    for _ in range(23):
        half.train_step()
    half.save(path)
    resumed = Trainer(images, FIELD, short).run(checkpoint=path)
    assert whole.gains is not None
    np.testing.assert_array_equal(resumed.gains, whole.gains)
    with pytest.raises(CheckpointError, match="one of others"):
        Trainer(images, FIELD, dataclasses.replace(short, exposure=False)).restore(path)
