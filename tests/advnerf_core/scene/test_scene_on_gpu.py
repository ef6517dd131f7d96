"""Training on an accelerator against the CPU kernels: bounded, unbounded and with alpha."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.render.march import MarchConfig, Marcher
from advnerf_core.render.occupancy import leap_distances
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.torch_step import TorchStep
from advnerf_core.scene.train import TrainConfig, Trainer
from advnerf_core.scene.train_step import CpuStep, Matte

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
GRID = HashGridConfig(levels=4, features=4, log2_entries=12, coarsest=8, finest=64)
BOUNDED = SceneFieldConfig((-1.0,) * 3, (1.0,) * 3, GRID, hidden=16, features=7, direction_bands=4)
FIELDS = [
    pytest.param(BOUNDED, id="bounded"),
    pytest.param(dataclasses.replace(BOUNDED, contraction=True), id="unbounded"),
    pytest.param(dataclasses.replace(BOUNDED, learned_background=False), id="alpha"),
]
MARCH = MarchConfig(near_m=0.05, smallest_step_m=0.02, largest_step_m=0.05, step_growth=0.03, max_samples=256)
CAMERA = Pinhole(24, 18, 16.0, 16.0, 12.0, 9.0)


def some_scene(config: SceneFieldConfig) -> SceneField:
    scene, generator = SceneField(config), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in scene.named_parameters():
            if name != "background":
                parameter.normal_(0.0, 0.3, generator=generator)
    return scene


@pytest.mark.parametrize("field", FIELDS)
def test_gradients_and_updates_agree_with_the_kernels(field: SceneFieldConfig) -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    directions /= field.extent_m * np.linalg.norm(directions, axis=1, keepdims=True)
    rays = np.concatenate([rng.uniform(0.2, 0.8, (500, 3)), directions], axis=1).astype(np.float32)
    leaps = leap_distances(rng.random((32, 32, 32)) > 0.5, np.full(3, 32.0))
    marcher = Marcher(1 << 19, MARCH, field.box_high, field.contraction)
    samples, kept = marcher(rays, rng.random(500, dtype=np.float32), leaps)
    assert len(kept) == 500
    targets = rng.integers(0, 256, (500, 3)).astype(np.uint8)
    matte = Matte(rng.integers(0, 256, 500).astype(np.uint8), rng.random((500, 3), dtype=np.float32))
    used = None if field.learned_background else matte
    kernels = CpuStep(some_scene(field), 0.1, distortion=0.3, opacity=0.02)
    device = TorchStep(some_scene(field).cuda(), 0.1, distortion=0.3, opacity=0.02)
    first, second = kernels.step(rays, targets, samples, used), device.step(rays, targets, samples, used)
    # A weight on the threshold of what shows may fall to either side.
    assert second.samples == pytest.approx(first.samples, rel=1e-3)
    assert second.loss == pytest.approx(first.loss, rel=1e-3)
    for name, gradient in device.grads.items():
        assert gradient.is_cuda
        scale = max(gradient.abs().max().item(), 1e-12)
        np.testing.assert_allclose(kernels.grads[name], gradient.cpu(), atol=2e-3 * scale, err_msg=name)
    device.update(0, 1e-3)
    fresh = TorchStep(some_scene(field).cuda(), 0.1)
    fresh.load_state(device.state())
    for name, value in device.state().items():
        np.testing.assert_array_equal(fresh.state()[name], value, err_msg=name)
    points = rng.random((1000, 3), dtype=np.float32)
    kernels.load_state(device.state())
    np.testing.assert_allclose(device.log_density(points), kernels.log_density(points), atol=1e-3)


@pytest.mark.parametrize("field", FIELDS)
def test_a_training_runs_there_and_its_scene_renders_here(field: SceneFieldConfig) -> None:
    rng = np.random.default_rng(2)
    poses = np.stack([look_at(rng.uniform(-0.5, 0.5, 3), rng.normal(size=3)) for _ in range(6)])
    rgb = rng.integers(0, 256, (6, 18, 24, 3)).astype(np.uint8)
    alpha = None if field.learned_background else rng.integers(0, 256, (6, 18, 24)).astype(np.uint8)
    config = TrainConfig(
        steps=40,
        samples_per_step=4096,
        max_rays=512,
        occupancy_resolution=16,
        warmup_steps=8,
        march=MARCH,
        opacity=0.0,
    )
    trainer = Trainer(ImageSet(rgb, (CAMERA,) * 6, poses, alpha), field, config)
    assert isinstance(trainer.stepper, TorchStep)
    assert trainer.scene.background.is_cuda
    with torch.no_grad():
        early = FieldRenderer(trainer.scene, trainer.occupied(), MARCH).render(poses[:1], CAMERA)[0]
        losses = [trainer.train_step().loss for _ in range(30)]
        trained = trainer.run()
    assert np.mean(losses[-5:]) < np.mean(losses[:5])
    assert torch.isfinite(early).all()
    assert not trained.scene.background.is_cuda
    picture = FieldRenderer(trained.scene, trained.occupied, trained.march).render(poses[:1], CAMERA)[0]
    assert torch.isfinite(picture).all()
