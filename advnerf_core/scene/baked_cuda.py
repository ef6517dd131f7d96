"""A baked scene drawn on a GPU: one thread for each pixel, with samples and values as in ``baked_kernels``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import cuda, float32
from torch import Tensor

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.render.cuda_launch import launch
from advnerf_core.render.march_kernels import span_in_box, step_size
from advnerf_core.render.rays import intrinsics_row, poses_in_box, write_ray
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.baked_kernels import BYTE, INTO_CELL, LOWEST, STEP, TINY, between

_span_in_box = cuda.jit(device=True)(span_in_box.py_func)
_step_size = cuda.jit(device=True)(step_size.py_func)
_write_ray = cuda.jit(device=True)(write_ray.py_func)
_between = cuda.jit(device=True)(between.py_func)
_f = np.float32
_ZERO, _ONE, _HALF, _INSIDE, _THIN, _FAR = _f(0.0), _f(1.0), _f(0.5), _f(1e-3), _f(1e-3), _f(np.inf)


@cuda.jit(device=True)
def _to_edge(place: Any, step: Any, cell: Any, reach: Any) -> Any:
    """Ray length from ``place`` to the edge of the empty block around ``cell`` along one axis."""
    return (_f(cell + reach if step > _ZERO else cell - reach + 1) - place) * (_ONE / step)


@cuda.jit
def render_baked_cuda(poses: Any, intrinsics: Any, high: Any, near: Any, steps: Any, distance: Any, cells: Any, brick_of: Any, log_sides: Any,
                      words: Any, behind: Any, least_through: Any, max_samples: int, rgb: Any, depth_m: Any) -> None:  # fmt: skip
    """Render a batch of images; arguments as for ``render_baked``, except the image ``rgb [B, 3, H, W]``."""
    n: int = cuda.grid(1)  # type: ignore[call-arg]
    height, width = depth_m.shape[1], depth_m.shape[2]
    if n >= depth_m.shape[0] * height * width:
        return
    image, v, u = n // (height * width), n // width % height, n % width
    nx, ny, nz = brick_of.shape
    ray, step = cuda.local.array(6, float32), cuda.local.array(3, float32)
    scale = _write_ray(poses[image], intrinsics, _f(u) + _HALF, _f(v) + _HALF, ray)
    t, end = _span_in_box(ray, high, _f(near))
    unit = math.sqrt(ray[3] * ray[3] + ray[4] * ray[4] + ray[5] * ray[5])
    for axis in range(3):
        ray[axis] *= cells[axis]
        along = ray[3 + axis] * cells[axis]
        step[axis] = along if abs(along) > TINY else TINY
    through, reach_m, red, green, blue, taken = _ONE, _ZERO, _ZERO, _ZERO, _ZERO, 0
    while t < end and taken < max_samples and through >= _f(least_through):
        x, y, z = ray[0] + t * step[0], ray[1] + t * step[1], ray[2] + t * step[2]
        i, j, k = (
            min(max(np.int64(x), 0), nx - 1),
            min(max(np.int64(y), 0), ny - 1),
            min(max(np.int64(z), 0), nz - 1),
        )
        clear = np.int64(distance[i, j, k])
        if clear > 0:
            leap = min(
                min(_to_edge(x, step[0], i, clear), _to_edge(y, step[1], j, clear)),
                _to_edge(z, step[2], k, clear),
            )
            t += max(leap, _ZERO) + INTO_CELL
            continue
        span = _step_size(t, steps)
        s = t + _HALF * span
        x = min(max(ray[0] + s * step[0], _ZERO), _f(nx) - _INSIDE)
        y = min(max(ray[1] + s * step[1], _ZERO), _f(ny) - _INSIDE)
        z = min(max(ray[2] + s * step[2], _ZERO), _f(nz) - _INSIDE)
        t += span
        taken += 1
        i, j, k = np.int64(x), np.int64(y), np.int64(z)
        fx, fy, fz = x - _f(i), y - _f(j), z - _f(k)
        begin, line, plane = np.int64(brick_of[i, j, k]), nz + 1, (ny + 1) * (nz + 1)
        if begin >= 0:
            side = np.int64(1) << np.int64(log_sides[i, j, k])
            fx, fy, fz = fx * _f(side), fy * _f(side), fz * _f(side)
            i, j, k = min(np.int64(fx), side - 1), min(np.int64(fy), side - 1), min(np.int64(fz), side - 1)
            fx, fy, fz = fx - _f(i), fy - _f(j), fz - _f(k)
            line, plane = side + 1, (side + 1) * (side + 1)
        at = max(begin, 0) + i * plane + j * line + k
        on = at + plane
        log, r, g, b = _between(
            words[at], words[at + 1], words[at + line], words[at + line + 1],
            words[on], words[on + 1], words[on + line], words[on + line + 1],
            fx, fy, fz,
        )  # fmt: skip
        keep = math.exp(-math.exp(log * STEP + LOWEST) * span * unit)
        weight = through * (_ONE - keep)
        through *= keep
        reach_m += weight * s
        red, green, blue = red + weight * r, green + weight * g, blue + weight * b
    rgb[image, 0, v, u] = red * BYTE + through * behind[0]
    rgb[image, 1, v, u] = green * BYTE + through * behind[1]
    rgb[image, 2, v, u] = blue * BYTE + through * behind[2]
    opacity = _ONE - through
    depth_m[image, v, u] = scale * reach_m / opacity if opacity > _THIN else _FAR


class CudaBaked:
    """A `BakedScene` in the memory of the GPU.

    Args:
        scene: The scene, copied to the GPU once.
    """

    def __init__(self, scene: BakedScene, device: torch.device) -> None:
        self.device = device
        self._scene = scene
        voxels, leaps = scene.voxels, scene.leaps
        self._grids = tuple(
            self._there(each)
            for each in (
                leaps.distance,
                leaps.cells,
                voxels.brick_of,
                voxels.log_sides,
                voxels.words,
                voxels.behind,
            )
        )
        self._high, self._steps = self._there(scene.config.box_high), self._there(scene.march.steps())

    def render(self, T_world_from_camera: Array, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
        """Colours ``[B, H, W, 3]`` in 0..1 and planar depth ``[B, H, W]`` [m] of views ``[B, 4, 4]``, float32, on the device."""
        scene, config = self._scene, self._scene.config
        shape = (len(T_world_from_camera), pinhole.height, pinhole.width)
        depth_m = torch.empty(shape, device=self.device)
        rgb = torch.empty((shape[0], 3, *shape[1:]), device=self.device)
        poses = self._there(poses_in_box(T_world_from_camera, config.origin_m, config.extent_m))
        launch(render_baked_cuda, depth_m.numel(), poses, self._there(intrinsics_row(pinhole)), self._high, scene.march.near_m, self._steps,
               *self._grids, scene.least_transmittance, scene.march.max_samples, rgb, depth_m)  # fmt: skip
        return rgb.permute(0, 2, 3, 1), depth_m

    def _there(self, array: Any) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)
