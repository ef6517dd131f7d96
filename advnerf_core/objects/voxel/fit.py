"""Fits voxel grids to pictures with transparency, by volume rendering.

The pictures are drawn from a mesh (to repair losses of voxelising at thin and slanted parts) or are cut-out photographs.
Density and colours are fitted together by Adam over random rays, each with a different background, so that transparency cannot
be faked by a colour. Density may be negative at voxels and is cut off after interpolation (Karnewar et al. 2022, "ReLU Fields"): edges
are then sharp, and lie anywhere between voxel centres.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import grid_sample

from advnerf_core.adam import Adam
from advnerf_core.objects.voxel.pictures import FitError, PosedRgba, RayBatches, crossing
from advnerf_core.objects.voxel.voxelise import OPAQUE_PER_VOXEL, ObjectGrids

LEARNING_RATE = 0.15
_EDGE = 1e-3  # the logistic function of the density never reaches 0 or 1 at the start
_SPARSITY = 1e-3
_FAINT = 0.01


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit.

    Attributes:
        gain_db: Decrease of the training error from the last but one to the last fifth of the steps [dB].
    """

    grids: ObjectGrids
    steps: int
    gain_db: float


def fit_grids(
    views: PosedRgba,
    start: ObjectGrids,
    steps: int = 300,
    rays: int = 2048,
    progress: Callable[[float, str], None] | None = None,
    max_seconds: float | None = None,
    learning_rate: float = LEARNING_RATE,
) -> Fit:
    """Fit density and colours to the pictures.

    Memory does not grow with the pictures: each step makes only its own rays.

    Args:
        start: Initial grids; voxels further than two from any with density stay empty.
        steps: Optimiser steps; 0 returns the start unchanged.
        progress: Called after each step with the finished fraction and a text.
        max_seconds: Stop after this much time, if sooner [s]. The learning rate falls with the finished fraction, so that a fit
            that is stopped by time ends as smoothly as one that is stopped by steps.
        learning_rate: Adam's rate at the start.

    Raises:
        FitError: Too few pictures, or none shows the object or looks at the box.
    """
    views.refuse_useless()
    batches = RayBatches(views, start.box_min, start.box_max, seed=0)
    torch_rng = torch.Generator().manual_seed(0)
    field = _Field(start)
    optimiser = Adam(field.parameters)
    began, errors, fraction = time.monotonic(), list[float](), 0.0 if steps > 0 else 1.0
    while fraction < 1.0:
        errors.append(_error(field, batches.draw(rays), torch_rng))
        optimiser.step(learning_rate * _cosine(fraction))
        by_time = 0.0 if max_seconds is None else (time.monotonic() - began) / max_seconds
        fraction = min(1.0, max(len(errors) / steps, by_time))
        if progress is not None:
            progress(fraction, f"step {len(errors)}, {_psnr(errors[-50:]):.1f} dB on training rays")
    return Fit(field.grids(), len(errors), _gain_db(errors))


def _error(field: _Field, batch: tuple[Tensor, Tensor, Tensor], torch_rng: torch.Generator) -> float:
    """Mean squared error on a batch of rays; leaves the gradients in the parameters."""
    target, origins, directions = batch
    count = len(target)
    background = torch.rand(count, 3, generator=torch_rng)
    colour, alpha = field.render(origins, directions, torch.rand(count, 1, generator=torch_rng))
    got = colour + (1.0 - alpha) * background
    wanted = target[:, :3] + (1.0 - target[:, 3:]) * background
    error = (got - wanted).square().mean()
    (error + _SPARSITY * field.opacity_between()).backward()
    return float(error.detach())


def _cosine(fraction: float) -> float:
    """Half a cosine from 1 to a tenth."""
    return 0.1 + 0.45 * (1.0 + math.cos(math.pi * fraction))


def _psnr(errors: Sequence[float]) -> float:
    return -10.0 * math.log10(max(float(np.mean(errors)), 1e-12))


def _gain_db(errors: Sequence[float]) -> float:
    fifth = len(errors) // 5
    return 0.0 if fifth == 0 else _psnr(errors[-fifth:]) - _psnr(errors[-2 * fifth : -fifth])


class _Field:
    """Grids as parameters. Voxel values sit at voxel centres and are clamped at the border, as in the casting of objects."""

    def __init__(self, start: ObjectGrids) -> None:
        self._start = start
        self._densest = OPAQUE_PER_VOXEL / start.voxel
        share = np.clip(0.5 + 0.5 * start.density / self._densest, _EDGE, 1.0 - _EDGE)
        self._raw = torch.tensor(np.log(share) - np.log1p(-share), requires_grad=True)
        colours = np.clip(start.colours, _EDGE, 1.0 - _EDGE)
        self._theta = torch.tensor(np.log(colours) - np.log1p(-colours), requires_grad=True)
        active = ndimage.binary_dilation(start.density > 0, np.ones((3, 3, 3)), iterations=2)
        self._active = torch.from_numpy(active.astype(np.float32))
        self._reached = torch.from_numpy(ndimage.binary_dilation(active, np.ones((3, 3, 3))))
        self._low = torch.tensor(start.box_min, dtype=torch.float32)
        self._high = torch.tensor(start.box_max, dtype=torch.float32)
        self._step = start.voxel / 2.0
        self.parameters = {"raw": self._raw, "theta": self._theta}

    def _share(self) -> Tensor:
        """Density as a share of the largest, from -1 to 1."""
        return (2.0 * torch.sigmoid(self._raw) - 1.0) * self._active

    def opacity_between(self) -> Tensor:
        """Mean of ``p (1 - p)``: zero when every voxel is either empty or opaque."""
        share = torch.relu(self._share())
        return (share * (1.0 - share)).mean()

    def render(self, origins: Tensor, directions: Tensor, jitter: Tensor) -> tuple[Tensor, Tensor]:
        """Premultiplied colours ``[R, 3]`` and coverage ``[R, 1]`` of rays with unit directions."""
        near, far = crossing(origins, directions, self._low, self._high)
        count = int(torch.ceil((far - near).max().clamp(min=0.0) / self._step)) + 1
        t = near[:, None] + (torch.arange(count) + jitter) * self._step
        points = origins[:, None] + t[..., None] * directions[:, None]
        unit = (points - self._low) / (self._high - self._low)
        sizes = torch.tensor(self._reached.shape)
        index = (unit * sizes).long().clamp(min=0)
        index = torch.minimum(index, sizes - 1)
        inside = (t < far[:, None]) & self._reached[index[..., 0], index[..., 1], index[..., 2]]
        grid = torch.cat(
            [self._densest * self._share()[None], torch.sigmoid(self._theta).permute(3, 0, 1, 2)]
        )
        where = (2.0 * unit[inside] - 1.0).flip(-1)
        values = grid_sample(
            grid[None], where[None, None, None], mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0, 0].T
        sigma = torch.zeros(t.shape).index_put((inside,), torch.relu(values[:, 0]))
        depth = torch.cumsum(sigma * self._step, dim=1)
        weights = torch.exp(-(depth - sigma * self._step)) - torch.exp(-depth)
        colours = torch.zeros(*t.shape, 3).index_put((inside,), values[:, 1:])
        return (weights[..., None] * colours).sum(1), weights.sum(1, keepdim=True)

    def grids(self) -> ObjectGrids:
        with torch.no_grad():
            share = self._share().numpy()
            # A voxel that lets nearly everything through is made empty: it costs time in every picture.
            filled = share >= _FAINT
            share = np.where(filled, share, np.minimum(share, 0.0))
            # Further out, negative values change nothing.
            share[~ndimage.binary_dilation(filled, np.ones((3, 3, 3)))] = 0.0
            density = (self._densest * share).astype(np.float32)
            colours = torch.sigmoid(self._theta).numpy()
        if not filled.any():
            raise FitError(
                "expected an object in the box, the pictures agree that it is empty: are box and poses right?"
            )
        return ObjectGrids(density, colours, self._start.box_min, self._start.box_max)
