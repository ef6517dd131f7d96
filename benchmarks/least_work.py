"""What the main computations must do at least: bytes in a row, lines of 64 bytes at random, float operations. Counted from sizes.

A line that is read again by the same block of 256 points counts once: the first-level cache holds it. What is computed again to save
memory, index arithmetic and exponentials do not count. So a floor can be missed for good reasons, but not undercut.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

from advnerf_core.fields.hash_grid import PRIME_Y, PRIME_Z, HashGridConfig
from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.render.march import Samples
from advnerf_core.scene.baked import Voxels
from benchmarks.machine_floors import LINE_BYTES, Floors

_FLOAT = 4
_BLOCKS = 64  # of points that are counted; the rest is scaled
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True)
class Work:
    """What a computation must do at least.

    Attributes:
        streamed: Bytes read or written in a row.
        lines: Lines of 64 bytes at random, by the bytes of the table that they lie in.
        flops: Float operations; a multiply-add has two.
    """

    streamed: float
    lines: dict[int, float]
    flops: float

    @property
    def line_count(self) -> float:
        """Lines of all tables."""
        return sum(self.lines.values())

    def floor_s(self, floors: Floors) -> tuple[float, str]:
        """Least time [s] and what bounds it: memory and arithmetic may overlap, so the longer of the two counts."""
        streamed_s = self.streamed / floors.stream_bps
        lines_s = sum(count * floors.line_of(table) for table, count in self.lines.items())
        flops_s = self.flops / floors.flops
        if flops_s > streamed_s + lines_s:
            return flops_s, "arithmetic"
        return streamed_s + lines_s, "random lines" if lines_s > streamed_s else "stream"


def encoding(points: NDArray[np.float32], grid: HashGridConfig) -> Work:
    """Hash encoding of points ``[N, 3]``, or its transpose: points and encodings in a row, table entries at random.

    Of the transpose, that each line is also written back is not counted.
    """
    lines: dict[int, float] = {}
    for level in grid.level_table():
        rows = level_rows(points[: _BLOCKS * TILE], level)
        blocks = [
            _distinct_lines(rows[n : n + TILE], grid.features * _FLOAT) for n in range(0, len(rows), TILE)
        ]
        size = table_bytes(level, grid.features)
        lines[size] = lines.get(size, 0.0) + sum(blocks) * len(points) / len(rows)
    # Position and cell 6, trilinear weights 15, eight vertices.
    flops = len(points) * grid.levels * (21 + 16 * grid.features)
    return Work(len(points) * _FLOAT * (3 + grid.width), lines, flops)


def level_rows(points: NDArray[np.float32], level: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows ``[N, 8]`` of the eight vertices around points ``[N, 3]``, from the first of the level."""
    _, cells, mask, dense = (int(value) for value in level)
    low = np.minimum((np.clip(points, 0.0, 1.0) * np.float32(cells)).astype(np.int64), cells - 1)
    x, y, z = np.moveaxis(low[:, None] + _CORNERS, -1, 0)
    if dense:
        return np.asarray(x + (cells + 1) * (y + (cells + 1) * z))
    return np.asarray((x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & mask)


def table_bytes(level: NDArray[np.int64], features: int) -> int:
    """Bytes of the table of a level."""
    _, cells, mask, dense = (int(value) for value in level)
    return ((cells + 1) ** 3 if dense else mask + 1) * features * _FLOAT


def two_layers(samples: int, widths: tuple[int, int, int], backward: bool) -> Work:
    """A network of one hidden layer on so many samples, ``widths`` of input, hidden layer and output.

    Backwards: the gradient of weights and inputs, two products for each one forwards. Weights stay in the cache.
    """
    inputs, hidden, outputs = widths
    forward = 2.0 * samples * hidden * (inputs + outputs)
    moved = samples * _FLOAT * (inputs + outputs)
    return Work(moved + backward * samples * _FLOAT * inputs, {}, forward * (2.0 if backward else 1.0))


def baked_frame(
    samples: Samples, through: NDArray[np.float32], least: float, voxels: Voxels, cells: NDArray[np.float32]
) -> Work:
    """A frame through a baked scene: each line that a sample needs comes from memory once, and colour, depth and opacity are written.

    Args:
        samples: Of all pixels of the frame.
        through: Transmittance up to each sample ``[N]``; a ray ends where less than ``least`` is left.
        least: That transmittance.
        voxels: The scene.
        cells: Cells per unit ``[3]``.
    """
    lit = through >= least
    rows = baked_rows(samples.points[lit], voxels, cells)
    lines = _distinct_lines(rows, voxels.values.shape[1])
    # Four values of eight corners each, eight weights, and what they are weighted with along the ray.
    return Work(5.0 * _FLOAT * samples.rays, {voxels.values.nbytes: float(lines)}, 90.0 * lit.sum())


def baked_rows(points: NDArray[np.float32], voxels: Voxels, cells: NDArray[np.float32]) -> NDArray[np.int64]:
    """Rows ``[N, 8]`` of the corner values around points ``[N, 3]`` in box coordinates."""
    shape = np.array(voxels.brick_of.shape)
    place = np.clip(points * cells, 0.0, shape - 1e-3)
    cell = place.astype(np.int64)
    brick = voxels.brick_of[tuple(cell.T)].astype(np.int64)
    side = np.int64(1) << voxels.log_sides[tuple(cell.T)].astype(np.int64)
    part = np.minimum(((place - cell) * side[:, None]).astype(np.int64), side[:, None] - 1)
    fine = brick >= 0
    at, along = np.where(fine[:, None], part, cell), np.where(fine, side + 1, shape[2] + 1)
    plane = np.where(fine, along * along, (shape[1] + 1) * (shape[2] + 1))
    corners = at[:, None] + _CORNERS
    rows = corners[..., 0] * plane[:, None] + corners[..., 1] * along[:, None] + corners[..., 2]
    return np.asarray(rows + np.where(fine, brick, 0)[:, None])


def casting(weights: sparse.csr_matrix, density_bytes: int) -> Work:
    """Casting an object: the voxels that show are read, and the weights written; two operations for each weight."""
    lines = float(len(np.unique(weights.indices.astype(np.int64) * 8 // LINE_BYTES)))
    return Work(
        weights.nnz * (weights.data.itemsize + weights.indices.itemsize),
        {density_bytes: lines},
        2.0 * weights.nnz,
    )


def composing(weights: sparse.csr_matrix, pixels: int) -> Work:
    """A sparse product for three channels: weights and background are read, the picture written."""
    read = weights.nnz * (weights.data.itemsize + weights.indices.itemsize)
    return Work(read + 2.0 * pixels * 3 * _FLOAT, {}, 6.0 * weights.nnz)


def network(module: torch.nn.Module, images: torch.Tensor) -> Work:
    """A policy's forward pass: convolutions and linear layers; its weights are read once."""
    counts: list[float] = []

    def count(layer: torch.nn.Module, _: object, out: torch.Tensor) -> None:
        if isinstance(layer, torch.nn.Conv2d):
            counts.append(2.0 * out.numel() * layer.weight[0].numel())
        if isinstance(layer, torch.nn.Linear):
            counts.append(2.0 * out.numel() * layer.in_features)

    hooks = [layer.register_forward_hook(count) for layer in module.modules()]
    with torch.no_grad():
        module(images)
    for hook in hooks:
        hook.remove()
    parameters = sum(value.nbytes for value in module.parameters())
    return Work(float(parameters + images.nbytes), {}, sum(counts))


def _distinct_lines(rows: NDArray[np.int64], row_bytes: int) -> int:
    return len(np.unique(rows * row_bytes // LINE_BYTES))
