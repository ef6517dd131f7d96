"""Fits voxel grids to pictures with transparency, by volume rendering.

The pictures are drawn from a mesh (to repair what voxelising loses at thin and slanted parts) or are photographs that were cut out.
Density and colours are fitted together by Adam over random rays, each with a background of its own, so that transparency cannot
be faked by a colour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import grid_sample

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.objects.voxelise import OPAQUE_PER_VOXEL, ObjectGrids

_LEARNING_RATE = 0.15
_EDGE = 1e-3  # the logistic function of the density never reaches 0 or 1 at the start
_SPARSITY = 1e-3


class FitError(AdvnerfError, ValueError):
    """Pictures that no object can be fitted to."""


@dataclass(frozen=True, eq=False)
class PosedRgba:
    """Pictures of an object with transparency.

    Attributes:
        images: Premultiplied ``[N, H, W, 4]`` float32 in 0..1.
        T_object_from_camera: ``[N, 4, 4]``, OpenCV axes.
        pinholes: Intrinsics of each.
    """

    images: NDArray[np.float32]
    T_object_from_camera: Array
    pinholes: tuple[Pinhole, ...]

    def __post_init__(self) -> None:
        count = len(self.T_object_from_camera)
        size = (self.pinholes[0].height, self.pinholes[0].width) if self.pinholes else (0, 0)
        if self.images.shape != (count, *size, 4) or len(self.pinholes) != count:
            raise FitError(
                f"expected {count} pictures {[*size, 4]} with as many intrinsics, "
                f"got {list(self.images.shape)} and {len(self.pinholes)}"
            )
        if len(self.images) < 3:
            raise FitError(f"expected at least 3 pictures around the object, got {len(self.images)}")
        if not (np.isfinite(self.images).all() and np.isfinite(self.T_object_from_camera).all()):
            raise FitError("expected finite pixels and poses, got some that are not")
        if not self.images[..., 3].any():
            raise FitError("expected an object in the pictures, all of them are fully transparent")


def fit_grids(
    views: PosedRgba,
    start: ObjectGrids,
    steps: int = 300,
    rays: int = 2048,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> ObjectGrids:
    """Density and colours that explain the pictures.

    Args:
        views: The pictures.
        start: Where to begin; voxels further than two from any with density stay empty.
        steps: Optimiser steps.
        rays: Rays per step.
        seed: Of the rays and backgrounds.
        progress: Told the step and the mean squared error.
    """
    torch_rng = torch.Generator().manual_seed(seed)
    target, origins, directions = _rays_of(views, start)
    field = _Field(start)
    optimiser = torch.optim.Adam(field.parameters, lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1), eta_min=0.1 * _LEARNING_RATE)
    for step in range(steps):
        chosen = torch.randint(len(target), (rays,), generator=torch_rng)
        background = torch.rand(rays, 3, generator=torch_rng)
        colour, alpha = field.render(origins[chosen], directions[chosen], torch.rand(rays, 1, generator=torch_rng))
        got = colour + (1.0 - alpha) * background
        wanted = target[chosen, :3] + (1.0 - target[chosen, 3:]) * background
        error = (got - wanted).square().mean()
        optimiser.zero_grad(set_to_none=True)
        (error + _SPARSITY * field.opacity_between()).backward()
        optimiser.step()
        schedule.step()
        if progress is not None:
            progress(step + 1, float(error.detach()))
    return field.grids()


class _Field:
    """Grids as parameters. Voxel values sit at voxel centres and are clamped at the border, as in the casting of objects."""

    def __init__(self, start: ObjectGrids) -> None:
        self._start = start
        self._densest = OPAQUE_PER_VOXEL / start.voxel
        share = np.clip(start.density / self._densest, _EDGE, 1.0 - _EDGE)
        self._raw = torch.tensor(np.log(share) - np.log1p(-share), requires_grad=True)
        colours = np.clip(start.colours, _EDGE, 1.0 - _EDGE)
        self._theta = torch.tensor(np.log(colours) - np.log1p(-colours), requires_grad=True)
        active = ndimage.binary_dilation(start.density > 0, np.ones((3, 3, 3)), iterations=2)
        self._active = torch.from_numpy(active.astype(np.float32))
        self._reached = torch.from_numpy(ndimage.binary_dilation(active, np.ones((3, 3, 3))))
        self._low = torch.tensor(start.box_min, dtype=torch.float32)
        self._high = torch.tensor(start.box_max, dtype=torch.float32)
        self._step = start.voxel / 2.0
        self.parameters = [self._raw, self._theta]

    def _density(self) -> Tensor:
        return self._densest * torch.sigmoid(self._raw) * self._active

    def opacity_between(self) -> Tensor:
        """Mean of ``p (1 - p)``: zero when every voxel is either empty or opaque."""
        share = torch.sigmoid(self._raw)
        return (share * (1.0 - share) * self._active).mean()

    def render(self, origins: Tensor, directions: Tensor, jitter: Tensor) -> tuple[Tensor, Tensor]:
        """Premultiplied colours ``[R, 3]`` and coverage ``[R, 1]`` of rays with unit directions."""
        near, far = _crossing(origins, directions, self._low, self._high)
        count = int(torch.ceil((far - near).max().clamp(min=0.0) / self._step)) + 1
        t = near[:, None] + (torch.arange(count) + jitter) * self._step
        points = origins[:, None] + t[..., None] * directions[:, None]
        unit = (points - self._low) / (self._high - self._low)
        sizes = torch.tensor(self._reached.shape)
        index = (unit * sizes).long().clamp(min=0)
        index = torch.minimum(index, sizes - 1)
        inside = (t < far[:, None]) & self._reached[index[..., 0], index[..., 1], index[..., 2]]
        grid = torch.cat([self._density()[None], torch.sigmoid(self._theta).permute(3, 0, 1, 2)])
        where = (2.0 * unit[inside] - 1.0).flip(-1)
        values = grid_sample(
            grid[None], where[None, None, None], mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0, 0].T
        sigma = torch.zeros(t.shape).index_put((inside,), values[:, 0])
        depth = torch.cumsum(sigma * self._step, dim=1)
        weights = torch.exp(-(depth - sigma * self._step)) - torch.exp(-depth)
        colours = torch.zeros(*t.shape, 3).index_put((inside,), values[:, 1:])
        return (weights[..., None] * colours).sum(1), weights.sum(1, keepdim=True)

    def grids(self) -> ObjectGrids:
        with torch.no_grad():
            density = self._density().numpy()
            # What lets through more than nearly everything is empty: it costs time in every picture.
            density = np.where(density < 0.01 * self._densest, 0.0, density).astype(np.float32)
            colours = torch.sigmoid(self._theta).numpy()
        if not density.any():
            raise FitError(
                "expected an object in the box, the pictures agree that it is empty: are box and poses right?"
            )
        return ObjectGrids(density, colours, self._start.box_min, self._start.box_max)


def _rays_of(views: PosedRgba, grids: ObjectGrids) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels ``[P, 4]``, ray origins and unit directions ``[P, 3]`` of all rays that meet the box."""
    low, high = (torch.tensor(corner, dtype=torch.float32) for corner in (grids.box_min, grids.box_max))
    pixels, origins, directions = [], [], []
    for image, T, lens in zip(views.images, views.T_object_from_camera, views.pinholes, strict=True):
        x = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
        y = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
        rays = np.stack([*np.meshgrid(x, y), np.ones((lens.height, lens.width))], axis=-1).reshape(-1, 3)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ np.asarray(T)[:3, :3].T
        direction = torch.from_numpy(rays).float()
        origin = torch.tensor(np.asarray(T)[:3, 3], dtype=torch.float32).expand_as(direction)
        near, far = _crossing(origin, direction, low, high)
        meets = far > near
        pixels.append(torch.from_numpy(image.reshape(-1, 4))[meets])
        origins.append(origin[meets])
        directions.append(direction[meets])
    if not sum(len(part) for part in pixels):
        raise FitError("expected the pictures to look at the object's box, none of them does: are box and poses right?")
    return torch.cat(pixels), torch.cat(origins), torch.cat(directions)


def _crossing(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    inverse = 1.0 / torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (low - origins) * inverse, (high - origins) * inverse
    return torch.minimum(a, b).amax(-1).clamp(min=0.0), torch.maximum(a, b).amin(-1)
