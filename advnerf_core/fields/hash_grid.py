"""Multiresolution hash encoding (Müller et al. 2022, "Instant Neural Graphics Primitives", section 3) as a torch module.

On a CPU in float32 it runs numba kernels; on any other device or dtype plain torch indexing, which is also the reference that the
kernels are tested against (to 1e-6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from advnerf_core.fields.hash_grid_kernels import (
    PRIME_Y,
    PRIME_Z,
    Array32,
    chunk_scratch,
    encode_level,
    rows_to_tiles,
    scatter_level,
)
from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.parallel import SLOTS, run_slots, slot_bounds


@dataclass(frozen=True)
class HashGridConfig:
    """Sizes of a multiresolution hash grid.

    Attributes:
        features: Features per entry F.
        log2_entries: Largest number of entries of a level, as a power of two.
        coarsest: Cells per axis of the coarsest level.
        finest: Cells per axis of the finest level; levels between grow geometrically.
    """

    levels: int = 16
    features: int = 2
    log2_entries: int = 17
    coarsest: int = 16
    finest: int = 2048

    def __post_init__(self) -> None:
        if not (1 <= self.levels <= 64 and self.features in (2, 4, 8, 16) and 4 <= self.log2_entries <= 24):
            raise ValueError(
                f"expected 1..64 levels, 2, 4, 8 or 16 features and 2^4..2^24 entries, got {self}"
            )
        if not 1 <= self.coarsest <= self.finest:
            raise ValueError(f"expected 1 <= coarsest <= finest cells, got {self.coarsest} and {self.finest}")

    @property
    def width(self) -> int:
        """Number of encoded features, L * F."""
        return self.levels * self.features

    def level_table(self) -> NDArray[np.int64]:
        """Level descriptions ``[L, 4]``: first row, cells per axis, index mask, densely indexed or not."""
        growth = (self.finest / self.coarsest) ** (1.0 / max(self.levels - 1, 1))
        rows, first = [], 0
        for level in range(self.levels):
            cells = int(np.floor(self.coarsest * growth**level + 1e-6))
            limit = 1 << self.log2_entries
            dense = (cells + 1) ** 3 <= limit
            rows.append((first, cells, limit - 1, int(dense)))
            first += (cells + 1) ** 3 if dense else limit
        return np.array(rows, dtype=np.int64)

    @property
    def entries(self) -> int:
        """Number of table rows over all levels."""
        first, cells, mask, dense = self.level_table()[-1]
        return int(first + ((cells + 1) ** 3 if dense else mask + 1))


class HashGrid(nn.Module):
    """Encodes points of the unit cube by trilinear interpolation in L hashed grids.

    Not differentiable to the points on the CPU float32 path (scene poses are never optimised); the plain torch path is, almost
    everywhere.
    """

    def __init__(
        self, config: HashGridConfig | None = None, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.config = config or HashGridConfig()
        self.levels = self.config.level_table()
        table = torch.empty(self.config.entries, self.config.features)
        # Müller et al., section 4: uniform and tiny, so that the first steps see a nearly constant field.
        self.table = nn.Parameter(table.uniform_(-1e-4, 1e-4, generator=generator))

    def forward(self, points: Tensor) -> Tensor:
        """Encode points.

        Args:
            points: ``[N, 3]`` in [0, 1]; coordinates outside are clamped.

        Returns:
            Features ``[N, L * F]``, level by level. On the CPU path this is a transposed view of feature-major memory.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"expected points [N, 3], got {tuple(points.shape)}")
        if self.table.device.type == "cpu" and self.table.dtype == points.dtype == torch.float32:
            return _NumbaEncode.apply(points, self.table, self.levels).T
        return encode_reference(points, self.table, self.levels)


def encode_reference(points: Tensor, table: Tensor, levels: NDArray[np.int64]) -> Tensor:
    """Plain torch indexing, any device and dtype, differentiable: points ``[N, 3]`` to features ``[N, L * F]``."""
    encoded = []
    for first, cells, mask, dense in levels.tolist():
        position = points.clamp(0.0, 1.0) * cells
        low = position.detach().floor().clamp(max=cells - 1).to(torch.int64)
        fraction = position - low
        total: Tensor | float = 0.0
        for corner in range(8):
            bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1], device=points.device)
            x, y, z = (low + bits).unbind(-1)
            plain, hashed = x + (cells + 1) * (y + (cells + 1) * z), x ^ (y * PRIME_Y) ^ (z * PRIME_Z)
            row = plain if dense else hashed & mask
            weight = torch.where(bits.bool(), fraction, 1.0 - fraction).prod(-1, keepdim=True)
            total = total + weight * table[first + row]
        encoded.append(total)
    return torch.cat([e for e in encoded if isinstance(e, Tensor)], dim=-1)


class _NumbaEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, levels: NDArray[np.int64]) -> Tensor:
        ctx.save_for_backward(points)
        ctx.levels, ctx.shape = levels, table.shape
        out = torch.empty(1, levels.shape[0] * table.shape[1], len(points))
        encode(points.detach().contiguous().numpy(), len(points), table.detach().numpy(), levels, out.numpy())
        return out[0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, None]:
        (points,) = ctx.saved_tensors
        grad_table = torch.empty(ctx.shape)
        grad_out = _in_tiles(grads[0].T.contiguous().numpy())
        at = points.detach().contiguous().numpy()
        scatter(at, len(points), grad_out, ctx.levels, grad_table.numpy(), from_zero=True)
        return None, grad_table, None


def _in_tiles(values: Array32) -> Array32:
    tiles = np.empty((-(-len(values) // TILE), values.shape[1], TILE), np.float32)
    bounds = slot_bounds(len(tiles), SLOTS)
    run_slots(lambda slot: rows_to_tiles(values, *bounds[slot], tiles), SLOTS)
    return tiles


def encode(points: Array32, count: int, table: Array32, levels: NDArray[np.int64], out: Array32) -> None:
    """``encode_level`` at all levels, in parallel over levels.

    One level at a time, so that its table (1 MB at 2^17 x 2) stays in the cache while all points pass.
    """
    last = levels.shape[0] - 1
    # Finest first: those miss the cache most, and a slow level at the end would leave the other threads waiting.
    run_slots(
        lambda slot: encode_level(points, count, table, last - slot, levels, *chunk_scratch(), out),
        levels.shape[0],
    )


def scatter(
    points: Array32,
    count: int,
    grad_out: Array32,
    levels: NDArray[np.int64],
    grad_table: Array32,
    from_zero: bool = False,
) -> None:
    """``scatter_level`` at all levels, in parallel over levels (no two write the same rows).

    ``from_zero`` overwrites ``grad_table``: a level is cleared while it is in the cache anyway.
    """
    last = levels.shape[0] - 1
    ends = [*levels[1:, 0].tolist(), len(grad_table)]

    def work(slot: int) -> None:
        level = last - slot
        if from_zero:
            grad_table[levels[level, 0] : ends[level]] = 0.0
        scatter_level(points, count, grad_out, level, levels, *chunk_scratch(), grad_table)

    run_slots(work, levels.shape[0])
