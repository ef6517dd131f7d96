"""Scene fields of random values, and samples on random rays."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.render.march import Samples
from advnerf_core.scene.field import SceneField, SceneFieldConfig


def random_field(config: SceneFieldConfig, seed: int) -> SceneField:
    """A field whose learned parameters are normal with a deviation of 0.3."""
    scene, generator = SceneField(config), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in scene.parameters():
            if parameter.requires_grad:
                parameter.normal_(0.0, 0.3, generator=generator)
    return scene


def random_samples(rng: np.random.Generator, counts: NDArray[np.int64], widest: float = 0.1) -> Samples:
    """Samples of rays, as many for each as ``counts`` says."""
    begins = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    t = np.concatenate([np.sort(rng.uniform(0.1, 1.5, n)) for n in counts]).astype(np.float32)
    points = rng.random((begins[-1], 3), dtype=np.float32)
    return Samples(points, t, rng.uniform(0.01, widest, begins[-1]).astype(np.float32), begins)
