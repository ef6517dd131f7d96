"""The CPU kernels of `soft_pose`: pixels of one object whose density is soft, and their derivative with respect to its placement.

A ray is sampled at planar depths ``(k + 1/2) step`` that do not depend on the placement. With positions ``p_i`` in the object, optical
depths ``tau_i = sigma(p_i) step |d| / scale`` and colours ``c_i``, a ray shows ``sum_i w_i c_i`` with ``w_i = T_i (1 - exp(-tau_i))`` and
``T_i = exp(-sum_{j<i} tau_j)``. For slopes ``g`` of colour and ``a`` of alpha, let ``e_i = g.c_i + a``; then

    dL/dtau_i = T_i exp(-tau_i) e_i - sum_{j>i} w_j e_j,    dL/dc_i = w_i g,

and the chain through ``p_i`` needs only the sums of ``dL/dp_i``, ``p_i x dL/dp_i``, ``p_i . dL/dp_i`` and ``tau_i dL/dtau_i``. Nothing of a sample
outlives its ray: the backward pass walks each ray again, so memory is limited to the covered pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.cast_kernels import NEAR_M, cell_of, share_of, span_in_box, steps_to_leap

# What the backward pass sums up: forces, torques, stretch, thinning.
SUMS = 8


@njit(**KERNEL_OPTIONS)
def _inside(position: float, count: int) -> float:
    """Derivative of the clamped position: 1 between the first and the last voxel centre, 0 beyond."""
    return 1.0 if 0.0 < position < count - 1.0 else 0.0


@njit(**KERNEL_OPTIONS)
def _extinction(x: float, y: float, z: float, density: Any) -> float:
    """Trilinear density at voxel coordinates."""
    nx, ny, nz = density.shape
    cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
    fx, fy, fz = share_of(x, cx, nx), share_of(y, cy, ny), share_of(z, cz, nz)
    ax, ay, az = min(cx + 1, nx - 1), min(cy + 1, ny - 1), min(cz + 1, nz - 1)
    near = ((density[cx, cy, cz] * (1.0 - fz) + density[cx, cy, az] * fz) * (1.0 - fy)
            + (density[cx, ay, cz] * (1.0 - fz) + density[cx, ay, az] * fz) * fy)  # fmt: skip
    far = ((density[ax, cy, cz] * (1.0 - fz) + density[ax, cy, az] * fz) * (1.0 - fy)
           + (density[ax, ay, cz] * (1.0 - fz) + density[ax, ay, az] * fz) * fy)  # fmt: skip
    return float(near * (1.0 - fx) + far * fx)


@njit(**KERNEL_OPTIONS)
def _walk(o: Any, d: Any, density: Any, clear: Any, one_sided: bool, step_m: float, length: float, least: float,
          depths: Any, taus: Any) -> int:  # fmt: skip
    """Samples of one ray that lie in cells that are not empty, until little light is left: planar depths and optical depths."""
    nx, ny, nz = density.shape
    t_in, t_out, _ = span_in_box(o, d, density.shape, NEAR_M)
    if t_out <= t_in or (one_sided and d[0] >= 0.0):
        return 0
    count, k, light = 0, int(np.ceil(t_in / step_m - 0.5)), 1.0
    while (k + 0.5) * step_m < t_out:
        t = (k + 0.5) * step_m
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
        reach = int(clear[cx, cy, cz])
        if reach > 0:
            leap = min(
                steps_to_leap(x, step_m * d[0], cx, reach),
                steps_to_leap(y, step_m * d[1], cy, reach),
                steps_to_leap(z, step_m * d[2], cz, reach),
            )
            k += max(leap, 1)
            continue
        k += 1
        sigma = _extinction(x, y, z, density)
        if sigma <= 0.0:  # outside a surface between voxels
            continue
        depths[count], taus[count] = t, sigma * length
        light *= np.exp(-taus[count])
        count += 1
        if light < least:
            break
    return count


@njit(**KERNEL_OPTIONS)
def _colour(x: float, y: float, z: float, slots: Any, colours: Any, out: Any) -> None:
    """Trilinear colour at voxel coordinates."""
    nx, ny, nz = slots.shape
    cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
    fx, fy, fz = share_of(x, cx, nx), share_of(y, cy, ny), share_of(z, cz, nz)
    out[0] = out[1] = out[2] = 0.0
    for k in range(8):
        part = (fx if k & 1 else 1.0 - fx) * (fy if k & 2 else 1.0 - fy) * (fz if k & 4 else 1.0 - fz)
        if part > 0.0:
            slot = slots[
                min(cx + 1, nx - 1) if k & 1 else cx, min(cy + 1, ny - 1) if k & 2 else cy,
                min(cz + 1, nz - 1) if k & 4 else cz,
            ]  # fmt: skip
            for channel in range(3):
                out[channel] += part * colours[slot, channel]


@njit(**KERNEL_OPTIONS)
def _ray(pixel: int, s: int, R: Any, intrinsics: Any, size: Any, supersample: int, d: Any) -> float:
    """Direction of unit planar depth in voxel coordinates, into ``d``; returns its length in the world."""
    v, u = (pixel // size[1]) % size[0], pixel % size[1]
    x = (u + (s % supersample + 0.5) / supersample - intrinsics[2]) / intrinsics[0]
    y = (v + (s // supersample + 0.5) / supersample - intrinsics[3]) / intrinsics[1]
    for axis in range(3):
        d[axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2]
    return float(np.sqrt(x * x + y * y + 1.0))


@njit(**KERNEL_OPTIONS)
def shade_pixels(first: int, last: int, pixels: Any, R: Any, o: Any, intrinsics: Any, size: Any, supersample: int,
                 slots: Any, density: Any, clear: Any, one_sided: bool, step_m: float, scale: float, least: float,
                 colours: Any, depths: Any, taus: Any, out: Any) -> None:  # fmt: skip
    """Colour, alpha and planar depth of some pixels.

    Args:
        first: First of ``pixels`` to shade.
        last: End.
        pixels: Flat indices into ``[B, H, W]``, ``[P]``.
        R: Directions of unit planar depth in each camera to voxel coordinates ``[B, 3, 3]``.
        o: Camera centres in voxel coordinates ``[B, 3]``.
        intrinsics: ``fx, fy, cx, cy``.
        size: Height and width.
        supersample: Rays along each side of a pixel.
        slots: ``[nx, ny, nz]``.
        density: ``[nx, ny, nz]`` per object unit.
        clear: Cells around each cell that are empty.
        one_sided: Only rays that come from in front (``+x``) count.
        step_m: Planar depth between samples [m].
        scale: World metres per object unit.
        least: A ray is followed until less light than this remains.
        colours: Colour vector ``[rows, 3]``.
        depths: Scratch for the samples of a ray.
        taus: Scratch.
        out: Premultiplied red, green, blue, then alpha, then alpha-weighted depth, ``[P, 5]``, written.
    """
    share, d, colour = 1.0 / (supersample * supersample), np.empty(3), np.empty(3)
    for n in range(first, last):
        b = pixels[n] // (size[0] * size[1])
        for s in range(supersample * supersample):
            length = _ray(pixels[n], s, R[b], intrinsics, size, supersample, d) * step_m / scale
            count = _walk(o[b], d, density, clear, one_sided, step_m, length, least, depths, taus)
            light = share
            for i in range(count):
                t = depths[i]
                weight = light * -np.expm1(-taus[i])
                _colour(o[b, 0] + t * d[0], o[b, 1] + t * d[1], o[b, 2] + t * d[2], slots, colours, colour)
                for channel in range(3):
                    out[n, channel] += weight * colour[channel]
                out[n, 3] += weight
                out[n, 4] += weight * t
                light *= np.exp(-taus[i])


@njit(**KERNEL_OPTIONS)
def _pull(x: float, y: float, z: float, slots: Any, density: Any, colours: Any, g: Any, weight: float, thick: float,
          rows: Any, force: Any) -> None:  # fmt: skip
    """Derivative of ``weight * g.c + thick * sigma`` with respect to the position, and ``weight g`` into the rows of ``c``."""
    nx, ny, nz = slots.shape
    cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
    fx, fy, fz = share_of(x, cx, nx), share_of(y, cy, ny), share_of(z, cz, nz)
    force[0] = force[1] = force[2] = 0.0
    for k in range(8):
        ix, iy, iz = (
            min(cx + 1, nx - 1) if k & 1 else cx, min(cy + 1, ny - 1) if k & 2 else cy, min(cz + 1, nz - 1) if k & 4 else cz,
        )  # fmt: skip
        slot = slots[ix, iy, iz]
        wx, wy, wz = (fx if k & 1 else 1.0 - fx), (fy if k & 2 else 1.0 - fy), (fz if k & 4 else 1.0 - fz)
        value = thick * density[ix, iy, iz]
        for channel in range(3):
            value += weight * g[channel] * colours[slot, channel]
        force[0] += (value if k & 1 else -value) * wy * wz
        force[1] += (value if k & 2 else -value) * wx * wz
        force[2] += (value if k & 4 else -value) * wx * wy
        if len(rows):
            part = wx * wy * wz * weight
            if part > 0.0:
                for channel in range(3):
                    rows[slot, channel] += part * g[channel]
    force[0] *= _inside(x, nx)
    force[1] *= _inside(y, ny)
    force[2] *= _inside(z, nz)


@njit(**KERNEL_OPTIONS)
def pull_pixels(first: int, last: int, pixels: Any, R: Any, o: Any, intrinsics: Any, size: Any, supersample: int,
                slots: Any, density: Any, clear: Any, one_sided: bool, step_m: float, scale: float, least: float,
                colours: Any, depths: Any, taus: Any, slopes: Any, low: Any, edges: Any, rows: Any, sums: Any) -> None:  # fmt: skip
    """The backward pass of `shade_pixels`, which has the arguments up to ``taus``.

    Args:
        slopes: Slopes of red, green, blue and alpha of each pixel, ``[P, 4]``.
        low: Corner of the box in object units ``[3]``.
        edges: Object units per voxel ``[3]``.
        rows: Derivative with respect to the colour vector ``[rows, 3]``, added to; of no rows if it is not wanted.
        sums: Force, torque, stretch (``p . dL/dp``) and thinning (``tau dL/dtau``) in object units, ``[8]``, added to.
    """
    share, d, colour, force = 1.0 / (supersample * supersample), np.empty(3), np.empty(3), np.empty(3)
    values, p = np.empty(len(taus)), np.empty(3)
    for n in range(first, last):
        b, g = pixels[n] // (size[0] * size[1]), slopes[n]
        for s in range(supersample * supersample):
            length = _ray(pixels[n], s, R[b], intrinsics, size, supersample, d) * step_m / scale
            count = _walk(o[b], d, density, clear, one_sided, step_m, length, least, depths, taus)
            behind, light = 0.0, share
            for i in range(count):
                t = depths[i]
                _colour(o[b, 0] + t * d[0], o[b, 1] + t * d[1], o[b, 2] + t * d[2], slots, colours, colour)
                values[i] = g[0] * colour[0] + g[1] * colour[1] + g[2] * colour[2] + g[3]
                behind += light * -np.expm1(-taus[i]) * values[i]
                light *= np.exp(-taus[i])
            light = share
            for i in range(count):
                t = depths[i]
                left = np.exp(-taus[i])
                weight = light * -np.expm1(-taus[i])
                behind -= weight * values[i]
                by_tau = light * left * values[i] - behind
                light *= left
                x, y, z = o[b, 0] + t * d[0], o[b, 1] + t * d[1], o[b, 2] + t * d[2]
                _pull(x, y, z, slots, density, colours, g, weight, by_tau * length, rows, force)
                p[0], p[1], p[2] = (
                    (x + 0.5) * edges[0] + low[0],
                    (y + 0.5) * edges[1] + low[1],
                    (z + 0.5) * edges[2] + low[2],
                )
                for axis in range(3):
                    force[axis] /= edges[axis]
                    sums[axis] += force[axis]
                    sums[6] += p[axis] * force[axis]
                sums[3] += p[1] * force[2] - p[2] * force[1]
                sums[4] += p[2] * force[0] - p[0] * force[2]
                sums[5] += p[0] * force[1] - p[1] * force[0]
                sums[7] += taus[i] * by_tau
