"""Voxel grids from a mesh: density and colour of each voxel.

Meshes in the wild have holes, doubled walls and inner parts, so inside and outside are not derived from the triangles. The surface is
drawn into a finer grid; inside is any cell that cannot be reached from outside without crossing it, or that is enclosed on five of its six
sides (a hydrant that is open below); the signed distance to that body gives the density of the coarse voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from advnerf_core.geometry import Array
from advnerf_core.objects.voxel.mesh import MeshError, SurfaceMesh

MAX_RESOLUTION = 128
# Extinction inside, per voxel: anything behind one voxel of it shows through by less than 1e-8.
OPAQUE_PER_VOXEL = 20.0
_PADDING = 2
# An open shell counts as filled if this many of the six axis directions meet its surface.
_SHUT_IN = 5


@dataclass(frozen=True, eq=False)
class ObjectGrids:
    """Density and colour at voxel centres.

    Attributes:
        density: Extinction per object unit, ``[nx, ny, nz]`` float32; negative values stand for empty space, and the surface is where
            the interpolated density passes zero.
        colours: ``[nx, ny, nz, 3]`` float32 in 0..1, defined everywhere.
        box_min: Corner of the box in object units, ``[3]``.
        box_max: Opposite corner.
    """

    density: NDArray[np.float32]
    colours: NDArray[np.float32]
    box_min: Array
    box_max: Array

    @property
    def voxel(self) -> float:
        """Edge of a voxel in object units."""
        return float(self.box_max[0] - self.box_min[0]) / self.density.shape[0]


def voxelise(mesh: SurfaceMesh, resolution: int = 64, thickened: bool = False) -> ObjectGrids:
    """Density and colour grids of a mesh.

    Args:
        mesh: The mesh [m]; metres become the object's units.
        resolution: Voxels along the longest side of the box, padding included, 8 to 128.
        thickened: Whether the body reaches half a voxel farther on each side, so that sheets are not lost between the voxels.

    Raises:
        MeshError: A resolution out of range, or a mesh without a surface.
    """
    if not 8 <= resolution <= MAX_RESOLUTION:
        raise MeshError(f"expected 8 to {MAX_RESOLUTION} voxels along the longest side, got {resolution}")
    low, high = mesh.box
    voxel = float((high - low).max()) / (resolution - 2 * _PADDING)
    counts = np.maximum(np.ceil((high - low) / voxel).astype(np.int64), 1) + 2 * _PADDING
    middle = (low + high) / 2
    box_min = middle - 0.5 * voxel * counts
    fine = 4 if resolution <= 64 else 2
    surface, sums, hits = _drawn_surface(mesh, box_min, voxel, counts, fine)
    if not surface.any():
        raise MeshError("expected a mesh with a surface, all its triangles are degenerate")
    if thickened:
        surface = ndimage.binary_dilation(surface, iterations=fine // 2)
    # The body ends in the middle of its outermost fine cells, the surface at their border, half a fine cell further out.
    ramp = np.clip((0.5 - _coarse(_signed_distance(surface), fine)) / fine, -1.0, 1.0)
    # Cells far from the surface are plainly empty, and rays skip them.
    ramp[~ndimage.binary_dilation(ramp > 0.0, np.ones((3, 3, 3)))] = 0.0
    density = (OPAQUE_PER_VOXEL / voxel * ramp).astype(np.float32)
    return ObjectGrids(density, _spread_colours(sums, hits), box_min, box_min + voxel * counts)


def _drawn_surface(
    mesh: SurfaceMesh, box_min: Array, voxel: float, counts: Array, fine: int
) -> tuple[Any, Any, Any]:
    """Fine cells that the surface crosses, and per coarse voxel the sum and number of the colours in it."""
    surface = np.zeros(tuple(counts * fine), dtype=np.bool_)
    sums, hits = np.zeros((*counts, 3)), np.zeros(tuple(counts))
    for part in mesh.parts:
        _draw(part.triangles, part.uv, part.texture, box_min, voxel / fine, fine, surface, sums, hits)
    return surface, sums, hits


def _signed_distance(surface: NDArray[np.bool_]) -> Array:
    """Distance to the surface of the body in fine cells, negative inside; the body's border is its outermost cells' middle."""
    regions, _ = ndimage.label(~np.pad(surface, 1))
    outside = (regions == regions[0, 0, 0])[1:-1, 1:-1, 1:-1] & (_blocked_sides(surface) < _SHUT_IN)
    away, deep = ndimage.distance_transform_edt(outside), ndimage.distance_transform_edt(~outside)
    return np.asarray(np.where(outside, away, 1.0 - deep))


def _blocked_sides(surface: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Number of axis directions, of six, in which each cell meets the surface."""
    count = np.zeros(surface.shape, dtype=np.int8)
    for axis in range(3):
        count += np.logical_or.accumulate(surface, axis=axis)
        count += np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis=axis), axis)
    return count


def _coarse(values: Array, fine: int) -> Array:
    """Values at the coarse voxels' centres: the mean of the eight fine cells around each."""
    half = fine // 2
    nx, ny, nz = (n // fine for n in values.shape)
    blocks = values.reshape(nx, fine, ny, fine, nz, fine)
    core = slice(half - 1, half + 1)
    return np.asarray(blocks[:, core, :, core, :, core].mean(axis=(1, 3, 5)))


def _spread_colours(sums: Array, hits: Array) -> NDArray[np.float32]:
    """Mean colours where they exist, else the nearest one, so that interpolation never mixes in black."""
    nearest = ndimage.distance_transform_edt(hits == 0, return_distances=False, return_indices=True)
    mean = sums / np.maximum(hits, 1)[..., None]
    return np.asarray(mean[tuple(nearest)], dtype=np.float32)


@njit(cache=True, error_model="numpy", forceinline=True)
def _draw(
    triangles: Any,
    uv: Any,
    texture: Any,
    box_min: Any,
    cell: float,
    fine: int,
    surface: Any,
    sums: Any,
    hits: Any,
) -> None:
    """Walk each triangle on a lattice finer than half a cell along its two shorter edges."""
    nx, ny, nz = surface.shape
    height, width = texture.shape[:2]
    lengths, p = np.empty(3), np.empty(3)
    for f in range(len(triangles)):
        c = triangles[f]
        for k in range(3):
            lengths[k] = np.sqrt(((c[(k + 1) % 3] - c[k]) ** 2).sum())
        longest = int(np.argmax(lengths))
        # The corner opposite the longest edge joins the two shorter ones.
        i0, i1, i2 = (longest + 2) % 3, longest, (longest + 1) % 3
        n1 = int(2.5 * lengths[(longest + 2) % 3] / cell) + 1
        n2 = int(2.5 * lengths[(longest + 1) % 3] / cell) + 1
        for a in range(n1 + 1):
            for b in range(n2 + 1):
                s, t = a / n1, b / n2
                if s + t > 1.0 + 0.5 / max(n1, n2):
                    break
                for k in range(3):
                    p[k] = c[i0, k] + s * (c[i1, k] - c[i0, k]) + t * (c[i2, k] - c[i0, k])
                x = int((p[0] - box_min[0]) / cell)
                y = int((p[1] - box_min[1]) / cell)
                z = int((p[2] - box_min[2]) / cell)
                if x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz:
                    continue
                surface[x, y, z] = True
                u = uv[f, i0, 0] + s * (uv[f, i1, 0] - uv[f, i0, 0]) + t * (uv[f, i2, 0] - uv[f, i0, 0])
                v = uv[f, i0, 1] + s * (uv[f, i1, 1] - uv[f, i0, 1]) + t * (uv[f, i2, 1] - uv[f, i0, 1])
                column = min(int((u - np.floor(u)) * width), width - 1)
                row = min(int((1.0 - (v - np.floor(v))) * height), height - 1)
                for k in range(3):
                    sums[x // fine, y // fine, z // fine, k] += texture[row, column, k]
                hits[x // fine, y // fine, z // fine] += 1.0
