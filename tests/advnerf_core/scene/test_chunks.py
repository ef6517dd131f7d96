"""Front-to-back evaluation leaves out what is behind surfaces, and changes nothing else."""

import numpy as np
import pytest
import torch

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.render.march import Samples
from advnerf_core.render.volume_kernels import next_chunk
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.train_step import CpuStep

FIELD = SceneFieldConfig((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), HashGridConfig(4, 4, log2_entries=10, finest=64))


def dense_field() -> SceneField:
    """A field with random densities that stop rays after some tens of samples."""
    scene = SceneField(FIELD)
    with torch.no_grad():
        scene.grid.table.uniform_(-1.5, 1.5, generator=torch.Generator().manual_seed(0))
        scene.density_2.bias[0] = 3.0
    return scene


def random_samples(rays: int = 300) -> Samples:
    """Rays of 0 to 150 samples."""
    rng = np.random.default_rng(0)
    begins = np.concatenate([[0], np.cumsum(rng.integers(0, 150, rays))])
    count = int(begins[-1])
    points = rng.random((count, 3), dtype=np.float32)
    return Samples(points, rng.random(count, dtype=np.float32), np.full(count, 0.01, np.float32), begins)


def columns(tiles: np.ndarray, count: int) -> np.ndarray:
    """Tiles ``[tiles, K, TILE]`` as rows ``[count, K]``."""
    return np.moveaxis(tiles, 1, 2).reshape(-1, tiles.shape[1])[:count].copy()


@pytest.mark.parametrize("chunk", [1, 7, 16, 200])
def test_chunks_keep_the_same_samples_with_the_same_encodings(chunk: int) -> None:
    step, samples = CpuStep(dense_field()), random_samples()
    at_once, encoded = step.visible(samples)
    expected = columns(encoded, len(at_once.points))
    in_chunks, encoded, evaluated = step.visible_in_chunks(samples, chunk)
    for name in ("points", "t_mid_m", "widths", "begins"):
        np.testing.assert_array_equal(getattr(in_chunks, name), getattr(at_once, name))
    np.testing.assert_array_equal(columns(encoded, len(in_chunks.points)), expected)
    assert len(at_once.points) <= evaluated <= len(samples.points)


def test_what_lies_behind_a_surface_is_not_evaluated() -> None:
    scene = dense_field()
    with torch.no_grad():
        scene.density_2.bias[0] = 12.0
    samples = random_samples()
    evaluated = CpuStep(scene).visible_in_chunks(samples, 8)[2]
    assert evaluated < 0.5 * len(samples.points)


@pytest.mark.parametrize("chunk", [0, 16])
def test_a_step_has_the_same_gradient_with_chunks_and_counts_what_it_evaluated(chunk: int) -> None:
    samples = random_samples()
    rng = np.random.default_rng(1)
    rays = rng.random((samples.rays, 6), dtype=np.float32)
    pixels = rng.integers(0, 256, (samples.rays, 3)).astype(np.uint8)
    plain, other = CpuStep(dense_field()), CpuStep(dense_field(), chunk=chunk)
    expected, got = plain.step(rays, pixels, samples), other.step(rays, pixels, samples)
    assert (got.loss, got.samples) == (expected.loss, expected.samples)
    assert (got.evaluated > 0) == (chunk > 0)
    for name, grad in plain.grads.items():
        np.testing.assert_array_equal(other.grads[name], grad)


def test_a_larger_least_weight_drops_faint_samples() -> None:
    samples = random_samples()
    step = CpuStep(dense_field())
    many, few = (len(step.visible(samples, least)[0].points) for least in (5e-4, 5e-2))
    assert few < many


def test_next_chunk_takes_the_next_samples_of_rays_that_go_on() -> None:
    begins, reached = np.array([0, 5, 5, 9]), np.array([1, 5, 5])
    taken, starts = next_chunk(reached, begins, np.array([1.0, 1.0, 0.0], np.float32), 3)
    assert taken.tolist() == [1, 2, 3]
    assert starts.tolist() == [0, 3, 3, 3]
    assert reached.tolist() == [4, 5, 5]
