"""CUDA kernels that draw voxel-grid objects before a background, and pull slopes of images back to the objects' colours.

One thread for each pixel marches its rays through all objects, exactly as ``cast_kernels`` does on the CPU. A GPU has arithmetic to
spare and little fast memory, so no weights are kept: the gradient marches the same rays again.

Sums of slopes use whole numbers, whose order does not matter: threads add in any order, and the gradient has the same bits every time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import cuda, float64, int64

from advnerf_core.render.cast_kernels import (
    LEAST_TRANSMITTANCE,
    NEAR_M,
    cell_of,
    share_of,
    span_in_box,
    steps_to_leap,
)

MOST_OBJECTS = 32
# Columns of an object's whole numbers: voxels along each axis, where its voxels, cells and colours begin, how many colours are free, flags.
VOXELS, FIRST_VOXEL, FIRST_CELL, FIRST_COLOUR, FREE, SOLID, ONE_SIDED, WHOLE_NUMBERS = 0, 3, 4, 5, 6, 7, 8, 9
# Columns of its lengths: of a voxel's edges, and between samples, in object units.
EDGES, STEP, LENGTHS = 0, 3, 4
# What a look at an object finds.
_ALPHA, _DEPTH, _RED, _FOUND = 0, 1, 2, 5

_span_in_box = cuda.jit(device=True)(span_in_box.py_func)
_cell_of = cuda.jit(device=True)(cell_of.py_func)
_share_of = cuda.jit(device=True)(share_of.py_func)
_steps_to_leap = cuda.jit(device=True)(steps_to_leap.py_func)


@cuda.jit(device=True)
def _march(o: Any, d: Any, t_in: float, t_out: float, share: float, k: int, whole: Any, lengths: Any, slots: Any, density: Any, clear: Any,
           colours: Any, pulls: bool, slopes: Any, gradient: Any, found: Any) -> None:  # fmt: skip
    """One ray through one object: add to ``found``, or, if it ``pulls``, add its weights times ``slopes [3]`` to ``gradient``."""
    nx, ny, nz = whole[k, VOXELS], whole[k, VOXELS + 1], whole[k, VOXELS + 2]
    voxels, cells, first = whole[k, FIRST_VOXEL], whole[k, FIRST_CELL], whole[k, FIRST_COLOUR]
    solid = whole[k, SOLID] != 0
    across, along = max(ny - 1, 1), max(nz - 1, 1)
    speed = math.sqrt(
        (d[0] * lengths[k, EDGES]) ** 2
        + (d[1] * lengths[k, EDGES + 1]) ** 2
        + (d[2] * lengths[k, EDGES + 2]) ** 2
    )
    samples = 1 if solid else max(1, int(math.ceil((t_out - t_in) * speed / lengths[k, STEP])))  # noqa: RUF046 - a float on a GPU
    dt = (t_out - t_in) / samples
    begin = t_in if solid else t_in + 0.5 * dt
    gx, gy, gz = o[0] + begin * d[0], o[1] + begin * d[1], o[2] + begin * d[2]
    sx, sy, sz = dt * d[0], dt * d[1], dt * d[2]
    transmittance = 1.0
    i = 0
    while i < samples and transmittance > 0.0:
        x, y, z = gx + i * sx, gy + i * sy, gz + i * sz
        cx, cy, cz = _cell_of(x, nx), _cell_of(y, ny), _cell_of(z, nz)
        if not solid:
            reach = int64(clear[cells + (cx * across + cy) * along + cz])
            if reach > 0:
                leap = min(
                    _steps_to_leap(x, sx, cx, reach),
                    _steps_to_leap(y, sy, cy, reach),
                    _steps_to_leap(z, sz, cz, reach),
                )
                i += max(leap, 1)
                continue
        fx, fy, fz = _share_of(x, cx, nx), _share_of(y, cy, ny), _share_of(z, cz, nz)
        corner = voxels + (cx * ny + cy) * nz + cz
        to_x, to_y, to_z = (
            ny * nz * (min(cx + 1, nx - 1) - cx),
            nz * (min(cy + 1, ny - 1) - cy),
            min(cz + 1, nz - 1) - cz,
        )
        opacity = 1.0
        if not solid:
            sigma = 0.0
            for n in range(8):
                part = (fx if n & 1 else 1.0 - fx) * (fy if n & 2 else 1.0 - fy) * (fz if n & 4 else 1.0 - fz)
                at = corner + (to_x if n & 1 else 0) + (to_y if n & 2 else 0) + (to_z if n & 4 else 0)
                sigma += part * density[at]
            if sigma <= 0.0:  # outside a surface between voxels
                i += 1
                continue
            opacity = 1.0 - math.exp(-sigma * dt * speed)
            if transmittance * (1.0 - opacity) < LEAST_TRANSMITTANCE:
                opacity = 1.0
        weight = transmittance * opacity * share
        if not pulls:
            found[_ALPHA] += weight
            found[_DEPTH] += weight * (begin + i * dt)
        for n in range(8):
            part = (
                (fx if n & 1 else 1.0 - fx)
                * (fy if n & 2 else 1.0 - fy)
                * (fz if n & 4 else 1.0 - fz)
                * weight
            )
            slot = int64(
                slots[corner + (to_x if n & 1 else 0) + (to_y if n & 2 else 0) + (to_z if n & 4 else 0)]
            )
            for c in range(3):
                if not pulls:
                    found[_RED + c] += part * colours[first + slot, c]
                elif part > 0.0 and slot < whole[k, FREE]:
                    cuda.atomic.add(gradient, (first + slot, c), int64(part * slopes[c]))  # type: ignore[call-arg]
        transmittance *= 1.0 - opacity
        i += 1


@cuda.jit(device=True)
def _look(k: int, frame: Any, u: int, v: int, intrinsics: Any, supersample: int, whole: Any, lengths: Any, slots: Any, density: Any, clear: Any,
          colours: Any, pulls: bool, slopes: Any, gradient: Any, found: Any) -> None:  # fmt: skip
    """The rays of one pixel through one object; see `_march`."""
    o, d, sizes = cuda.local.array(3, float64), cuda.local.array(3, float64), cuda.local.array(3, int64)
    for axis in range(3):
        o[axis], sizes[axis] = frame[9 + axis], whole[k, VOXELS + axis]
    for s in range(supersample * supersample):
        x = (u + (s % supersample + 0.5) / supersample - intrinsics[2]) / intrinsics[0]
        y = (v + (s // supersample + 0.5) / supersample - intrinsics[3]) / intrinsics[1]
        for axis in range(3):
            d[axis] = frame[3 * axis] * x + frame[3 * axis + 1] * y + frame[3 * axis + 2]
        t_in, t_out, by_face = _span_in_box(o, d, sizes, NEAR_M)
        if t_out > t_in and (by_face or whole[k, ONE_SIDED] == 0):
            _march(o, d, t_in, t_out, 1.0 / (supersample * supersample), k, whole, lengths, slots, density, clear, colours, pulls, slopes,
                   gradient, found)  # fmt: skip


@cuda.jit
def draw_objects(frames: Any, windows: Any, intrinsics: Any, supersample: int, whole: Any, lengths: Any, slots: Any, density: Any, clear: Any,
                 colours: Any, texture_of: Any, behind_m: Any, tolerance_m: float, image: Any, shares: Any,
                 nothing: Any) -> None:  # fmt: skip
    """Draw all objects of a batch of images before its background, one thread for each pixel.

    Args:
        frames: For each object in each image: directions of unit planar depth in the camera to voxel coordinates, row by row, then the camera's
            centre there ``[K, B, 12]`` float64.
        windows: First row, end row, first column, end column ``[K, B, 4]``.
        intrinsics: ``fx, fy, cx, cy`` ``[4]`` float64.
        supersample: Rays along each side of a pixel.
        whole: Whole numbers of each object ``[K, 9]`` int64, see above.
        lengths: Lengths of each object ``[K, 4]`` float64, see above.
        slots: Colour of each voxel of all objects, flat, int32.
        density: Density of the voxels, flat; not read for solid objects.
        clear: Cells around each cell that are empty, flat, uint8.
        colours: Colours for each texture ``[N, V, 3]``.
        texture_of: Index of each image's texture ``[B]`` int32.
        behind_m: Planar depth of the background ``[B, H, W]`` [m]; NaN is infinitely far.
        tolerance_m: Distance behind the background at which an object is still visible [m].
        image: Background ``[B, 3, H, W]``, which objects are drawn into.
        shares: Share of the light that each object keeps ``[K, B, H, W]``, written.
        nothing: An empty gradient ``[0, 3]`` int64.
    """
    n: int = cuda.grid(1)  # type: ignore[call-arg]
    height, width = image.shape[2], image.shape[3]
    if n >= image.shape[0] * height * width:
        return
    b, v, u = n // (height * width), n // width % height, n % width
    layers = cuda.local.array((MOST_OBJECTS, _FOUND), float64)
    order, found = cuda.local.array(MOST_OBJECTS, int64), cuda.local.array(_FOUND, float64)
    count = 0
    for k in range(whole.shape[0]):
        shares[k, b, v, u] = 0.0
        inside = windows[k, b, 0] <= v < windows[k, b, 1] and windows[k, b, 2] <= u < windows[k, b, 3]
        if not inside:
            continue
        for c in range(_FOUND):
            found[c] = 0.0
        _look(k, frames[k, b], u, v, intrinsics, supersample, whole, lengths, slots, density, clear, colours[texture_of[b]], False, found,
              nothing, found)  # fmt: skip
        alpha = min(found[_ALPHA], 1.0)
        if alpha <= 0.0:
            continue
        layers[k, _ALPHA] = alpha
        layers[k, _DEPTH] = found[_DEPTH] / found[_ALPHA] - tolerance_m
        for c in range(3):
            layers[k, _RED + c] = found[_RED + c]
        # The nearest first; at equal depth, objects keep their order.
        place = count
        while place > 0 and layers[order[place - 1], _DEPTH] > layers[k, _DEPTH]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
        count += 1
    light = 1.0
    for c in range(3):
        found[c] = 0.0
    for m in range(count):
        k = order[m]
        if layers[k, _DEPTH] > behind_m[b, v, u]:  # never true for NaN
            continue
        shares[k, b, v, u] = light
        for c in range(3):
            found[c] += light * layers[k, _RED + c]
        light *= 1.0 - layers[k, _ALPHA]
    for c in range(3):
        image[b, c, v, u] = image[b, c, v, u] * light + found[c]


@cuda.jit
def pull_objects(frames: Any, windows: Any, intrinsics: Any, supersample: int, whole: Any, lengths: Any, slots: Any, density: Any, clear: Any,
                 colours: Any, texture_of: Any, shares: Any, slopes: Any, scale: Any, gradient: Any) -> None:  # fmt: skip
    """Propagate slopes of images back to their colours; arguments as in `draw_objects`, and:

    Args:
        shares: From `draw_objects`.
        slopes: With respect to the images ``[B, 3, H, W]``.
        scale: Value of one in the gradient's whole numbers ``[1]`` float64.
        gradient: With respect to the colours ``[N, V, 3]`` int64, added to.
    """
    n: int = cuda.grid(1)  # type: ignore[call-arg]
    height, width = slopes.shape[2], slopes.shape[3]
    if n >= slopes.shape[0] * height * width:
        return
    b, v, u = n // (height * width), n // width % height, n % width
    own = cuda.local.array(3, float64)
    for k in range(whole.shape[0]):
        share = shares[k, b, v, u]
        if share <= 0.0:
            continue
        for c in range(3):
            own[c] = np.float64(slopes[b, c, v, u]) * share * scale[0]
        _look(k, frames[k, b], u, v, intrinsics, supersample, whole, lengths, slots, density, clear, colours[texture_of[b]], True, own,
              gradient[texture_of[b]], own)  # fmt: skip
