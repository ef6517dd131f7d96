"""Learned scenes rendered in plain torch, on any device: samples and rules are those of ``baked_kernels`` and ``render_kernels``.

All rays of an image take a number of steps side by side, each to its next sample or over empty cells. The samples found are then evaluated
together and composited; rays that have ended drop out. Sums along a ray have a fixed order, so results have the same bits every time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.render.cast_torch import trilinear
from advnerf_core.render.rays import poses_in_box
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.baked_kernels import BYTE, INTO_CELL, LOWEST, STEP, TINY
from advnerf_core.scene.field import SceneField
from advnerf_core.scene.render_field import FieldRenderer

# Rays side by side, and steps before their samples are evaluated together.
_RAYS, _STEPS = 1 << 17, 16
_INSIDE, _THIN = 1e-3, 1e-3

_Evaluate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""``(ray [S], ray parameter [S]) -> (density per ray parameter [S], values [S, C])`` of samples."""


class _Rays(NamedTuple):
    """Rays ``[R]``: origin and direction ``[R, 3]`` in box coordinates, and planar depth per unit of ray parameter."""

    origin: Tensor
    direction: Tensor
    scale: Tensor


class _TorchBackground(ABC):
    """A background renderer on a device.

    Args:
        here: The renderer on the CPU.
        ray_unit_m: Unit of ray parameters [m].
    """

    def __init__(
        self, here: BakedScene | FieldRenderer, device: torch.device, ray_unit_m: float = 1.0
    ) -> None:
        self._config, self._march, self._least = (
            here.config,
            here.march.in_unit(ray_unit_m),
            here.least_transmittance,
        )
        self._device, self._unit_m = device, ray_unit_m
        self._smallest, self._largest, self._growth = self._march.steps().tolist()
        self._high, self._cells = self._there(here.config.box_high), self._there(here.leaps.cells)
        self._size, self._distance = (
            self._there(np.array(here.leaps.distance.shape)),
            self._there(here.leaps.distance).reshape(-1),
        )

    @torch.no_grad()
    def __call__(self, T_world_from_camera: Array, pinhole: Pinhole) -> tuple[Tensor, Tensor, Tensor]:
        """Render a batch of views; arguments and results as in `FieldRenderer.render`, results on the device."""
        rays = self._rays(T_world_from_camera, pinhole)
        parts = [
            self._shown(_Rays(*part)) for part in zip(*(each.split(_RAYS) for each in rays), strict=True)
        ]
        shape = (len(T_world_from_camera), pinhole.height, pinhole.width)
        rgb, depth_m, alpha = (torch.cat(each) for each in zip(*parts, strict=True))
        return rgb.view(*shape, 3), depth_m.view(shape), alpha.view(shape)

    @abstractmethod
    def _shown(self, rays: _Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Colour, depth and alpha of rays."""

    def _there(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)

    def _rays(self, T_world_from_camera: Array, pinhole: Pinhole) -> _Rays:
        """As ``rays.write_ray``, image by image and row by row."""
        poses = self._there(
            poses_in_box(T_world_from_camera, self._config.origin_m, self._config.extent_m, self._unit_m)
        )
        x = (torch.arange(pinhole.width, device=self._device) + 0.5 - pinhole.cx) / pinhole.fx
        y = (torch.arange(pinhole.height, device=self._device) + 0.5 - pinhole.cy) / pinhole.fy
        aims = torch.stack([*torch.meshgrid(x, y, indexing="xy"), x.new_ones(len(y), len(x))], -1).view(-1, 3)
        scale = aims.norm(dim=1).reciprocal()
        direction = (poses[:, None, :, :3] * aims[:, None]).sum(-1) * scale[:, None]
        origin = poses[:, None, :, 3].expand_as(direction)
        return _Rays(origin.reshape(-1, 3), direction.reshape(-1, 3), scale.repeat(len(poses)))

    def _cell(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Cell of points ``[..., 3]`` in cell coordinates, clamped to the grid ``[..., 3]``, and its flat index."""
        cell = torch.minimum(points.long(), self._size - 1).clamp(min=0)
        return cell, (cell[..., 0] * self._size[1] + cell[..., 1]) * self._size[2] + cell[..., 2]

    def _marched(self, rays: _Rays, channels: int, evaluate: _Evaluate) -> tuple[Tensor, Tensor, Tensor]:
        """Sums of weighted values ``[R, C]``, remaining light ``[R]`` and planar depth ``[R]``, infinite where a ray is empty."""
        o, d = rays.origin, rays.direction
        sums, light = o.new_zeros(len(o), channels + 1), o.new_ones(len(o))
        t, end = self._span(o, d)
        taken = torch.zeros_like(t, dtype=torch.int64)
        going = (t < end).nonzero()[:, 0]
        while len(going):
            start = (each[going] for each in (o, d, t, end, taken))
            where, steps, t[going], taken[going] = self._advance(*start)
            row, column = (steps > 0.0).nonzero(as_tuple=True)
            span, ray = steps[row, column], going[column]
            middle = where[row, column] + 0.5 * span
            density, values = evaluate(ray, middle)
            depth = torch.zeros_like(steps)
            depth[row, column] = density * span
            after = light[going] * torch.exp(-torch.cumsum(depth, 0))
            before = torch.cat([light[going][None], after[:-1]])
            weight = torch.where(before >= self._least, before - after, 0.0)
            dense = o.new_zeros(*steps.shape, channels + 1)
            dense[row, column] = weight[row, column, None] * torch.cat([values, middle[:, None]], 1)
            sums[going] += dense.sum(0)
            light[going] -= weight.sum(0)
            left = (light >= self._least) & (t < end) & (taken < self._march.max_samples)
            going = going[left[going]]
        opacity = 1.0 - light
        depth_m = torch.where(opacity > _THIN, rays.scale * sums[:, -1] / opacity, torch.inf)
        return sums[:, :-1], light, depth_m

    def _span(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """``march_kernels.span_in_box`` for rays ``[R, 3]``."""
        along = d.abs() < 1e-12
        a, b = -o / d, (self._high - o) / d
        start = torch.where(along, -torch.inf, torch.minimum(a, b)).amax(1).clamp(min=self._march.near_m)
        end = torch.where(along, torch.inf, torch.maximum(a, b)).amin(1)
        return start, torch.where((along & ((o < 0.0) | (o > self._high))).any(1), -torch.inf, end)

    def _advance(self, o: Tensor, d: Tensor, t: Tensor, end: Tensor, taken: Tensor) -> tuple[Tensor, ...]:
        """A few steps of rays ``[R]``: ray parameters and lengths of the intervals ``[steps, R]``, 0 for leaps, then ``t`` and ``taken``."""
        o, d = o * self._cells, d * self._cells
        d = torch.where(d.abs() > float(TINY), d, float(TINY))
        found, intervals = [], []
        for _ in range(_STEPS):
            place = o + t[:, None] * d
            cell, flat = self._cell(place)
            clear = self._distance[flat].long()
            edge = torch.where(d > 0.0, cell + clear[:, None], cell - clear[:, None] + 1).to(o.dtype)
            leap = ((edge - place) / d).amin(1).clamp(min=0.0) + float(INTO_CELL)
            alive = (t < end) & (taken < self._march.max_samples)
            samples = alive & (clear == 0)
            span = (t * self._growth).clamp(self._smallest, self._largest)
            found.append(t)
            intervals.append(torch.where(samples, span, 0.0))
            t = torch.where(alive, t + torch.where(samples, span, leap), t)
            taken = taken + samples
        return torch.stack(found), torch.stack(intervals), t, taken


class TorchBaked(_TorchBackground):
    """A `BakedScene` on a device."""

    def __init__(self, scene: BakedScene, device: torch.device) -> None:
        super().__init__(scene, device)
        voxels = scene.voxels
        self._words, self._behind = self._there(voxels.words), self._there(voxels.behind)
        self._bricks, self._logs = (
            self._there(each.reshape(-1)) for each in (voxels.brick_of, voxels.log_sides)
        )

    def _shown(self, rays: _Rays) -> tuple[Tensor, Tensor, Tensor]:
        o, d, unit = rays.origin * self._cells, rays.direction * self._cells, rays.direction.norm(dim=1)
        d = torch.where(d.abs() > float(TINY), d, float(TINY))

        def evaluate(ray: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
            values = self._values(o[ray] + s[:, None] * d[ray])
            return torch.exp(values[:, 0] * float(STEP) + float(LOWEST)) * unit[ray], values[:, 1:]

        colours, light, depth_m = self._marched(rays, 3, evaluate)
        return colours * float(BYTE) + light[:, None] * self._behind, depth_m, 1.0 - light

    def _values(self, x: Tensor) -> Tensor:
        """``baked_kernels.between`` at positions ``[S, 3]`` in cell coordinates: ``[S, 4]``."""
        x = torch.minimum(x.clamp(min=0.0), self._size - _INSIDE)
        cell, flat = self._cell(x)
        brick = self._bricks[flat].long()
        coarse = (brick < 0)[:, None]
        side = torch.where(coarse, 1, (1 << self._logs[flat].long())[:, None])
        fine = (x - cell) * side
        inner = torch.where(coarse, cell, torch.minimum(fine.long(), side - 1))
        share = torch.where(coarse, x, fine) - inner
        corners = torch.where(coarse, self._size, side) + 1
        stride = torch.stack([corners[:, 1:].prod(1), corners[:, 2], torch.ones_like(brick)], 1)
        beyond, part = trilinear(share, stride)
        words = self._words[(brick.clamp(min=0) + (inner * stride).sum(1))[:, None] + beyond]
        levels = words[..., None] >> torch.arange(0, 32, 8, device=x.device, dtype=torch.int32) & 255
        return (part[..., None] * levels).sum(1)


class TorchField(_TorchBackground):
    """A `FieldRenderer` on a device; the field is not contracted."""

    def __init__(self, renderer: FieldRenderer, device: torch.device) -> None:
        super().__init__(renderer, device, renderer.config.ray_unit_m)
        self._renderer, self._field = renderer, SceneField(renderer.config).requires_grad_(False)
        self._field.load_state_dict({name: torch.from_numpy(each) for name, each in renderer.weights.items()})
        self._field.to(device)

    def _shown(self, rays: _Rays) -> tuple[Tensor, Tensor, Tensor]:
        unit, renderer = rays.direction.norm(dim=1), self._renderer

        def evaluate(ray: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
            points = rays.origin[ray] + s[:, None] * rays.direction[ray]
            density, features = self._field.density_and_features(points)
            return density * unit[ray], features

        sums, light, depth_m = self._marched(rays, renderer.config.features, evaluate)
        features = sums + light[:, None] * self._field.background
        rgb = self._field.decode(features, rays.direction / unit[:, None])
        if renderer.colour_map is not None:
            rgb = torch.from_numpy(renderer.colour_map.apply(rgb.cpu().numpy())).to(rgb)
        if not renderer.config.learned_background:
            rgb = (1.0 - light)[:, None] * rgb + light[:, None] * rgb.new_tensor(renderer.behind)
        return rgb, depth_m * renderer.config.ray_unit_m, 1.0 - light
