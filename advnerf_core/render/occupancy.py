"""Occupied space in the box: a grid of density bounds, updated while the field learns, and leap distances over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.contraction import radial_stretch

# Random places in each part of a cell where density is probed.
_PROBES = 6

Array32 = NDArray[np.float32]
LogDensity = Callable[[Array32], Array32]
"""Points ``[N, 3]`` in box coordinates to the logarithm of density ``[N]``."""

MAX_REACH = 32  # cells; leaps longer than that are rare and gain nothing
# Flat boxes of `flat_boxes`: cells across for each cell of height, and the largest height; codes from `FLAT` on are flat boxes.
FLATNESS, MAX_HEIGHT, FLAT = 4, 12, 128


@dataclass(frozen=True, eq=False)
class Leaps:
    """Leap distances, as the marching kernels read them.

    Attributes:
        distance: ``[X, Y, Z]`` uint8: 0 occupied, d > 0: all cells at Chebyshev distance below d are empty.
        cells: Cells per unit of box coordinates along each axis ``[3]`` float32.
    """

    distance: NDArray[np.uint8]
    cells: Array32


class OccupancyGrid:
    """Running upper estimate of density per cell (Müller et al. 2022, appendix C).

    Args:
        box_high: High corner of the box in box coordinates ``[3]``.
        resolution: Cells along the longest side.
        seed: Seed of the places inside cells where density is probed.
        contracted: Whether the grid is over the cube of a contracted field. The resolution is then made a multiple of 4, and an
            estimate counts by how long its cell is: thin haze in a large cell hides as much as dense fog in a small one.
    """

    def __init__(
        self, box_high: Array32, resolution: int = 128, seed: int = 0, contracted: bool = False
    ) -> None:
        self.box_high = np.asarray(box_high, np.float32)
        if contracted:
            resolution = -(-resolution // 4) * 4
        shape = np.maximum(1, np.ceil(self.box_high * resolution - 1e-4)).astype(int)
        self.shape: tuple[int, int, int] = (int(shape[0]), int(shape[1]), int(shape[2]))
        self.density = np.full(self.shape, np.inf, np.float32)
        self.seed = seed
        self._stretch = radial_stretch(self.shape) if contracted else None

    @property
    def cells(self) -> Array32:
        """Cells per unit of box coordinates along each axis ``[3]``."""
        return (np.array(self.shape) / self.box_high).astype(np.float32)

    def update(self, log_density: LogDensity, step: int, share: float, decay: float = 0.95) -> None:
        """Probe cells at random places inside them and keep ``max(decay * old, probed)``.

        Args:
            step: Training step; with the seed it determines the random numbers, so that a resumed run continues identically.
            share: Share of the cells to probe, 1 for all; chosen at random.
            decay: Factor on the old estimates of all cells: one without probes for long becomes empty.
        """
        rng = np.random.Generator(np.random.Philox(key=[self.seed, 2 * step + 1]))
        total = self.density.size
        chosen = np.arange(total) if share >= 1.0 else rng.integers(0, total, int(total * share))
        flat = self.density.reshape(-1)
        self.density *= np.float32(decay)
        for part in np.array_split(chosen, max(1, len(chosen) // 262144)):
            index = np.stack(np.unravel_index(part, self.shape), axis=-1)
            places = ((index + rng.random((len(part), 3), dtype=np.float32)) / self.cells).astype(np.float32)
            probed = np.exp(np.minimum(log_density(places), 15.0))
            flat[part] = np.fmax(np.where(np.isfinite(flat[part]), flat[part], 0.0), probed)

    def occupied(self, threshold: float) -> NDArray[np.bool_]:
        """Cells ``[X, Y, Z]`` whose density may exceed ``threshold`` or, early on, the mean."""
        finite = self.density[np.isfinite(self.density)]
        mean = float(finite.mean()) if finite.size else 0.0
        least = min(threshold, mean)
        if self._stretch is None:
            return np.asarray(self.density > least)
        # Cells that no place is mapped to have no length.
        return np.asarray(
            (self._stretch > 0.0) & (np.minimum(self.density, np.float32(1e30)) * self._stretch > least)
        )


def refine_occupied(
    occupied: NDArray[np.bool_],
    box_high: Array32,
    log_density: LogDensity,
    least_depth: float = 0.05,
    contracted: bool = False,
) -> NDArray[np.bool_]:
    """Split occupied cells and keep the parts that affect a ray.

    Args:
        occupied: ``[X, Y, Z]``.
        box_high: High corner of the box in box coordinates ``[3]``.
        least_depth: Optical depth of crossing a part, at the largest density found in it, from which it is kept.
        contracted: Whether the grid is over the cube of a contracted field.

    Returns:
        ``[2 X, 2 Y, 2 Z]``.
    """
    fine = occupied.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    rng = np.random.Generator(np.random.Philox(key=[0, 1]))
    cells = np.array(fine.shape) / np.asarray(box_high)
    least = least_depth * cells.max()
    stretch = (
        radial_stretch((fine.shape[0], fine.shape[1], fine.shape[2])).reshape(-1) if contracted else None
    )
    kept = np.zeros(fine.size, np.bool_)
    for part in np.array_split(np.flatnonzero(fine), max(1, int(fine.sum()) // 262144)):
        index = np.stack(np.unravel_index(part, fine.shape), axis=-1)
        largest: NDArray[np.float32] = np.full(len(part), -np.inf, np.float32)
        for _ in range(_PROBES):
            places = (index + rng.random((len(part), 3), dtype=np.float32)) / cells
            largest = np.maximum(largest, log_density(places.astype(np.float32)))
        # The cube is two inner regions wide: a part of the inner region is twice as long as its share of the cube.
        length = 1.0 if stretch is None else 2.0 * stretch[part]
        kept[part] = np.exp(np.minimum(largest, 15.0)) * length >= least
    return kept.reshape(fine.shape)


def leap_distances(occupied: NDArray[np.bool_], cells: Array32) -> Leaps:
    """Chebyshev distance to the nearest occupied cell, for occupied ``[X, Y, Z]``."""
    distance = np.where(occupied, np.uint8(0), np.uint8(MAX_REACH))
    _chamfer(distance)
    return Leaps(distance, np.asarray(cells, np.float32))


@njit(**KERNEL_OPTIONS)
def _chamfer(distance: NDArray[np.uint8]) -> None:
    """Two raster sweeps (Borgefors 1986) that turn 0 / MAX_REACH into chessboard distances.

    Of the thirteen neighbours that a sweep has already passed, the twelve of other rows are looked at a row at a time, in vectors of
    bytes; only the one before in the same row waits for its value.
    """
    nx, ny, nz = distance.shape
    # The least of the rows already passed, with a border on both sides.
    least = np.full(nz + 2, np.uint8(MAX_REACH), np.uint8)
    inner, before, after = least[1:-1], least[:-2], least[2:]
    for sweep in range(2):
        step = 1 - 2 * sweep
        for a in range(nx):
            i = a if sweep == 0 else nx - 1 - a
            for b in range(ny):
                j = b if sweep == 0 else ny - 1 - b
                row = distance[i, j]
                inner[:] = MAX_REACH
                if a > 0:
                    for passed in range(max(j - 1, 0), min(j + 2, ny)):
                        _lower(inner, distance[i - step, passed])
                if b > 0:
                    _lower(inner, distance[i, j - step])
                for k in range(nz):
                    row[k] = min(row[k], np.uint8(min(before[k], inner[k], after[k]) + 1))
                left = np.uint8(MAX_REACH)
                for c in range(nz):
                    k = c if sweep == 0 else nz - 1 - c
                    left = min(row[k], np.uint8(left + 1))
                    row[k] = left


@njit(**KERNEL_OPTIONS)
def _lower(least: NDArray[np.uint8], row: NDArray[np.uint8]) -> None:
    for k in range(len(least)):
        least[k] = min(least[k], row[k])


def flat_boxes(distance: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The empty box about each cell in which a ray leaps: the cube of its leap distance, or a flatter one where that is wider.

    A ray that passes low over a floor leaves every cube through its side, the sooner the lower it is. A box ``FLATNESS`` times as wide as
    high halves the number of leaps in a room.

    Args:
        distance: Leap distances ``[X, Y, Z]`` along x, y, and up.

    Returns:
        ``[X, Y, Z]`` uint8: 0 occupied; ``d < FLAT``: the cells nearer than ``d`` along each axis are empty; ``FLAT + h``: those nearer than
        ``FLATNESS * h`` along x and y, and nearer than ``h`` along z.
    """
    height = np.where(distance == 0, np.uint8(0), np.uint8(MAX_HEIGHT))
    for axis, across in ((2, 1), (1, FLATNESS), (0, FLATNESS)):
        height = _least_around(height, axis, across)
    return np.where(FLATNESS * height > distance, FLAT + height, distance)


def _least_around(height: NDArray[np.uint8], axis: int, across: int) -> NDArray[np.uint8]:
    """The smallest of ``max(height, cells // across)`` over the cells along an axis, which are so many ``cells`` away."""
    near = height  # the least among those nearer than a multiple of `across`
    for _ in range(across - 1):
        near = _spread(near, axis, 1)
    least = near.copy()
    for away in range(1, MAX_HEIGHT):
        near = _spread(near, axis, across)
        np.minimum(least, np.maximum(near, np.uint8(away)), out=least)
    return least


def _spread(values: NDArray[np.uint8], axis: int, by: int) -> NDArray[np.uint8]:
    """The least of each cell and of the two that lie ``by`` cells before and behind it."""
    spread = values.copy()
    there, here = spread.swapaxes(0, axis), values.swapaxes(0, axis)
    np.minimum(there[by:], here[:-by], out=there[by:])
    np.minimum(there[:-by], here[by:], out=there[:-by])
    return spread
