"""The plain torch training step against the CPU kernels, against closed forms, and as a backend of the trainer."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, Pinhole, look_at
from advnerf_core.render.march import MarchConfig, Samples
from advnerf_core.render.occupancy import refine_occupied
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.torch_step import TorchStep, distortion_loss, render_rays
from advnerf_core.scene.train import TrainConfig, Trainer
from advnerf_core.scene.train_step import CpuStep
from tests.support.fields import random_field, random_samples

GRID = HashGridConfig(levels=4, features=4, log2_entries=10, coarsest=4, finest=32)
FIELD = SceneFieldConfig((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), GRID, hidden=16, features=7, direction_bands=3)
CAMERA = Pinhole(16, 12, 12.0, 12.0, 8.0, 6.0)


def some_scene(seed: int) -> SceneField:
    scene = random_field(FIELD, seed)
    with torch.no_grad():
        scene.density_2.bias[0] = 1.5  # dense enough to hide what is behind
    return scene


def some_batch(rays: int = 200, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8], Samples]:
    """Rays with 0 to 30 samples each, empty ones among them, first and last too."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 31, rays)
    counts[[0, rays // 2, -1]] = 0
    samples = random_samples(rng, counts, widest=0.2)
    lines = rng.normal(size=(rays, 6)).astype(np.float32)
    return lines, rng.integers(0, 256, (rays, 3)).astype(np.uint8), samples


def test_loss_gradients_and_updates_agree_with_the_kernels() -> None:
    kernel_scene, torch_scene = some_scene(1), some_scene(1)
    kernels = CpuStep(kernel_scene, 0.1, distortion=0.3, opacity=0.05)
    plain = TorchStep(torch_scene, 0.1, distortion=0.3, opacity=0.05)
    for step in range(3):
        rays, targets, samples = some_batch(seed=step)
        first, second = kernels.step(rays, targets, samples), plain.step(rays, targets, samples)
        assert (first.rays, first.samples) == (second.rays, second.samples)
        assert 0 < first.samples < len(samples.points), "some samples are hidden, not all"
        assert second.loss == pytest.approx(first.loss, rel=1e-4)
        assert second.mse == pytest.approx(first.mse, rel=1e-4)
        for name, gradient in plain.grads.items():
            scale = gradient.abs().max().item()
            np.testing.assert_allclose(kernels.grads[name], gradient, atol=5e-5 * scale, err_msg=name)
        # From the same gradients on: Adam turns rounding of tiny gradients into whole steps.
        for name, gradient in plain.grads.items():
            kernels.grads[name][...] = gradient.numpy()
        kernels.update(step, 1e-3)
        plain.update(step, 1e-3)
        for name, value in plain.state().items():
            np.testing.assert_allclose(kernels.state()[name], value, rtol=1e-4, atol=2e-6, err_msg=name)


def test_densities_agree_with_the_kernels() -> None:
    points = np.random.default_rng(2).random((1000, 3), dtype=np.float32)
    scene = some_scene(3)
    np.testing.assert_allclose(
        TorchStep(scene).log_density(points), CpuStep(scene).log_density(points), atol=1e-5
    )


def constant_scene(log_density: float) -> SceneField:
    """The same density everywhere."""
    scene = some_scene(4)
    with torch.no_grad():
        scene.density_2.weight[0] = 0.0
        scene.density_2.bias[0] = log_density
    return scene


@pytest.mark.parametrize("opaque_first", [False, True])
def test_a_slab_has_the_transmittance_of_its_closed_form(opaque_first: bool) -> None:
    """``1 - exp(-sigma L)``, also behind a ray so dark that single precision sums would swallow this one."""
    sigma, length, count = 0.7, 0.5, 64
    widths = np.full(count, length / count, np.float32)
    points = np.full((count, 3), 0.5, np.float32)
    t = np.linspace(0.0, length, count, dtype=np.float32)
    begins = np.array([0, count])
    if opaque_first:
        widths = np.concatenate([np.full(count, 1e6, np.float32), widths])
        points, t, begins = np.tile(points, (2, 1)), np.tile(t, 2), np.array([0, count, 2 * count])
    rays = torch.ones(len(begins) - 1, 6)
    with torch.no_grad():
        _, weights, alpha = render_rays(
            constant_scene(float(np.log(sigma))), rays, Samples(points, t, widths, begins)
        )
    assert alpha[-1].item() == pytest.approx(1.0 - np.exp(-sigma * length), rel=1e-5)
    expected = np.exp(-sigma * length * np.arange(count) / count) * (1.0 - np.exp(-sigma * length / count))
    np.testing.assert_allclose(weights[-count:], expected, rtol=1e-5)


def test_distortion_is_the_double_sum_of_its_definition() -> None:
    _, _, samples = some_batch(20, seed=5)
    weights = torch.rand(len(samples.points), generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    middles, widths = torch.from_numpy(samples.t_mid_m).double(), torch.from_numpy(samples.widths).double()
    whole: float | Tensor = 0.0
    for start, stop in zip(samples.begins[:-1], samples.begins[1:], strict=True):
        w, m, d = weights[start:stop], middles[start:stop], widths[start:stop]
        whole = whole + (w[:, None] * w * (m[:, None] - m).abs()).sum() + (w * w * d).sum() / 3.0
    assert distortion_loss(weights, middles, widths, samples).item() == pytest.approx(float(whole), rel=1e-10)


def test_gradients_of_rendering_against_finite_differences() -> None:
    scene = some_scene(7).double()
    rays, _, samples = some_batch(6, seed=8)

    def loss(background: Tensor, bias: Tensor) -> Tensor:
        parameters = {"background": background, "density_2.bias": bias}
        module = _Rendering(scene, torch.from_numpy(rays).double(), samples)
        return torch.func.functional_call(module, {f"scene.{k}": v for k, v in parameters.items()}, ())  # type: ignore[no-any-return]

    start = [scene.background.detach().clone(), scene.density_2.bias.detach().clone()]
    assert torch.autograd.gradcheck(loss, [value.requires_grad_() for value in start], eps=1e-6, atol=1e-5)


class _Rendering(torch.nn.Module):
    def __init__(self, scene: SceneField, rays: Tensor, samples: Samples) -> None:
        super().__init__()
        self.scene, self.rays, self.samples = scene, rays, samples

    def forward(self) -> Tensor:
        return render_rays(self.scene, self.rays, self.samples)[0]


def striped_room(count: int) -> ImageSet:
    """Any images will do: what is compared is two ways to learn them."""
    rng = np.random.default_rng(9)
    poses: list[Array] = [look_at(rng.uniform(-0.3, 0.3, 3), rng.normal(size=3)) for _ in range(count)]
    rgb = np.tile(np.linspace(0, 255, 16).astype(np.uint8)[None, None, :, None], (count, 12, 1, 3))
    return ImageSet(rgb, (CAMERA,) * count, np.stack(poses))


TRAIN = TrainConfig(
    steps=12,
    samples_per_step=2048,
    max_rays=256,
    occupancy_resolution=16,
    warmup_steps=4,
    backend="torch",
    march=MarchConfig(
        near_m=0.05, smallest_step_m=0.05, largest_step_m=0.1, step_growth=0.02, max_samples=64
    ),
)


def test_a_training_in_torch_learns_as_the_kernels_do_and_resumes_in_them(tmp_path: Path) -> None:
    images, path = striped_room(4), tmp_path / "checkpoint.safetensors"
    kernels = Trainer(images, FIELD, dataclasses.replace(TRAIN, backend="numba"))
    plain = Trainer(images, FIELD, TRAIN)
    for _ in range(6):
        first, second = kernels.train_step(), plain.train_step()
        assert second.mse == pytest.approx(first.mse, rel=2e-2)
    plain.save(path)
    resumed = Trainer(images, FIELD, TRAIN)
    trained = resumed.run(checkpoint=path)
    plain.run()
    assert resumed.step == plain.step == 12
    for name, value in plain.stepper.state().items():
        np.testing.assert_array_equal(resumed.stepper.state()[name], value, err_msg=name)
    assert not trained.scene.background.is_cuda


def test_haze_stays_visible_where_it_is_asked_for() -> None:
    everywhere, box = np.ones((4, 4, 4), np.bool_), np.ones(3, np.float32)
    # Crossing one of the 8 fine cells along a side takes 0.02 of optical depth.
    log_density = TorchStep(constant_scene(float(np.log(8 * 0.02)))).log_density
    assert refine_occupied(everywhere, box, log_density, least_depth=0.015).all()
    assert not refine_occupied(everywhere, box, log_density, least_depth=0.025).any()


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(ValueError, match="auto, numba, torch"):
        TrainConfig(backend="jax")
