"""Baking of splats: the voxels of a volume that looks like the Gaussians, rendered like any baked scene.

Gaussians narrower than voxels are widened to them and keep their mass. Colours no longer depend on the direction: each is that seen from
the poses for which the scene is baked, the nearest ones counting most. What is outside the scene's box is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from advnerf_core.fields.spherical_harmonics import spherical_harmonics
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.parallel import run_slots, slot_bounds
from advnerf_core.render.march import MarchConfig
from advnerf_core.render.occupancy import leap_distances
from advnerf_core.scene.bake import NotBakedError, bake_corners
from advnerf_core.scene.baked import BakedScene
from advnerf_core.splats.gaussians import COLOUR_OFFSET, GaussianSplats
from advnerf_core.splats.projection import MOST_ALPHA
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.volume_kernels import (
    CELLS,
    LEVELS,
    MOST_Q,
    evaluate_gaussians,
    list_cells,
    profile_table,
)

_WIDENED = 0.5  # deviation of the smallest Gaussians, in spacings of points
_LEAST_DEPTH = 0.02  # optical depth of a cell from which it is occupied
_INTERVAL_PX = 1.0  # of a field's 4: layers are thinner than what a field learns
_LEAST_TRANSMITTANCE = 5e-3
_VIEWS = 24  # of the poses, for colours
_SLOTS, _CHUNK = 16, 1 << 20


def bake_splats(
    source: SplatRenderer, T_world_from_camera: ArrayLike, pinhole: Pinhole, cells_along: int = CELLS
) -> BakedScene:
    """Bake a splat inside its box.

    Args:
        T_world_from_camera: Poses ``[N, 4, 4]`` like the later ones.
        pinhole: Intrinsics of the later renders.
        cells_along: Cells of the occupancy along the longest side; a power of 2, at most `CELLS`.

    Raises:
        NotBakedError: The box has a size that no place has in metres.
    """
    if source.config.ray_unit_m != 1.0:
        raise NotBakedError(
            f"expected a splat in metres, got one of {source.config.extent_m:.4g} m; see 'advnerf scene from-splat --help'"
        )
    poses = np.asarray(T_world_from_camera, np.float64).reshape(-1, 4, 4)
    return bake_corners(SplatVolume(source, poses, pinhole, cells_along), poses, pinhole)


@dataclass(frozen=True, eq=False)
class Widened:
    """Gaussians that points ``spacing`` apart do not miss: inverse covariances ``[N, 6]``, densities ``[N]`` per box side, and lists by cell."""

    spacing: float
    inverses: NDArray[Any]
    amplitudes: NDArray[Any]
    begins: NDArray[Any]
    lists: NDArray[Any]


class SplatVolume:
    """The corner values of a splat; see `CornerValues`."""

    def __init__(self, source: SplatRenderer, poses: Array, pinhole: Pinhole, cells_along: int) -> None:
        box = source.config
        self.config, self.least_transmittance = box, _LEAST_TRANSMITTANCE
        self.behind = np.array(source.behind, np.float32)
        cell_m = box.extent_m / cells_along
        self.march = MarchConfig(source.near_m, cell_m / 16.0, 0.5 * cell_m, _INTERVAL_PX / pinhole.fx, 1024)
        splats = source.splats
        self._means = ((splats.means_m - np.array(box.box_low_m)) / box.extent_m).astype(np.float32)
        self._covariances = splats.covariances().astype(np.float64) / box.extent_m**2
        self._face = (
            np.prod(np.sort(splats.scales_m.astype(np.float64), axis=1)[:, 1:], axis=1) / box.extent_m**2
        )
        self._opacities = np.minimum(splats.opacities, np.float32(MOST_ALPHA))
        self._colours, self._table = _colours_seen(splats, poses), profile_table()
        self._widened = Widened(0.0, *(np.empty(0),) * 4)
        shape = tuple(int(n) for n in np.maximum(1, np.ceil(box.box_high * cells_along - 1e-4)))
        cells = (np.array(shape) / box.box_high).astype(np.float32)
        self.leaps = leap_distances(self._occupied(shape, cells), cells)

    def at(self, points: NDArray[np.float32], spacing: float) -> NDArray[np.uint8]:
        """See `CornerValues`."""
        return self._evaluated(points, spacing)[0]

    def _evaluated(
        self, points: NDArray[np.float32], spacing: float
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        if self._widened.spacing != spacing:  # of others, not needed again, the lists are large
            self._widened = self._widened_to(spacing)
        wide, points = self._widened, np.ascontiguousarray(points, np.float32)
        values, log_density = np.empty((len(points), 4), np.uint8), np.empty(len(points), np.float32)
        bounds = slot_bounds(len(points), _SLOTS)
        gaussians = (
            self._means,
            wide.inverses,
            wide.amplitudes,
            self._opacities,
            self._colours,
            wide.begins,
            wide.lists,
            self._table,
        )
        run_slots(
            lambda slot: evaluate_gaussians(points, *bounds[slot], *gaussians, values, log_density), _SLOTS
        )
        return values, log_density

    def _widened_to(self, spacing: float) -> Widened:
        covariances = self._covariances.copy()
        covariances[:, [0, 3, 5]] += (_WIDENED * spacing) ** 2
        xx, xy, xz, yy, yz, zz = covariances.T
        minors = [
            yy * zz - yz * yz,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xx * zz - xz * xz,
            xy * xz - xx * yz,
            xx * yy - xy * xy,
        ]
        det = np.maximum(xx * minors[0] + xy * minors[1] + xz * minors[2], 1e-300)
        inverses = (np.stack(minors, axis=1) / det[:, None]).astype(np.float32)
        amplitudes = (self._face / np.sqrt(2.0 * np.pi * det)).astype(np.float32)
        reach = np.sqrt(MOST_Q * covariances[:, [0, 3, 5]]).astype(np.float32)
        low, high = self._means - reach, self._means + reach
        begins = np.zeros(sum((CELLS >> level) ** 3 for level in range(LEVELS)) + 1, np.int32)
        list_cells(low, high, begins, np.empty(0, np.int32), True)
        np.cumsum(begins, out=begins)
        lists = np.empty(int(begins[-1]), np.int32)
        list_cells(low, high, begins[:-1].copy(), lists, False)
        return Widened(spacing, inverses, amplitudes, begins, lists)

    def _occupied(self, shape: tuple[int, ...], cells: NDArray[np.float32]) -> NDArray[np.bool_]:
        found = np.zeros(int(np.prod(shape)), np.bool_)
        along = max(shape)
        least = np.log(_LEAST_DEPTH * along)
        near = np.flatnonzero(self._listed(shape))
        for part in np.array_split(near, max(1, len(near) // _CHUNK)):
            centres = (np.stack(np.unravel_index(part, shape), axis=-1) + 0.5) / cells
            found[part] = self._evaluated(centres.astype(np.float32), 1.0 / along)[1] >= least
        return found.reshape(shape)

    def _listed(self, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Cells of the occupancy ``[X, Y, Z]`` that any Gaussian reaches."""
        self._evaluated(np.zeros((0, 3), np.float32), 1.0 / max(shape))
        counts, begin = np.diff(self._widened.begins), 0
        reached = np.zeros((CELLS,) * 3, np.bool_)
        for level in range(LEVELS):
            across = CELLS >> level
            some = counts[begin : begin + across**3].reshape((across,) * 3) > 0
            reached |= some.repeat(1 << level, 0).repeat(1 << level, 1).repeat(1 << level, 2)
            begin += across**3
        across, each = CELLS // max(shape), max(shape)
        merged = np.asarray(reached.reshape(each, across, each, across, each, across).any(axis=(1, 3, 5)))
        x, y, z = shape
        return merged[:x, :y, :z]


def _colours_seen(splats: GaussianSplats, poses: Array) -> NDArray[np.float32]:
    """Colours ``[N, 3]`` of the Gaussians from some of the poses, those in front of them and near counting most."""
    chosen = poses[np.unique(np.linspace(0, len(poses) - 1, _VIEWS).astype(int))].astype(np.float32)
    basis = np.zeros((len(splats), splats.bands**2), np.float32)
    total = np.zeros((len(splats), 1), np.float32)
    for pose in chosen:
        offsets = splats.means_m - pose[:3, 3]
        away = np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), np.float32(1e-6))
        ahead = (offsets @ pose[:3, 2])[:, None] > 0.5 * away
        weight = np.where(ahead, np.float32(1.0), np.float32(1e-3)) / (away * away)
        basis += weight * spherical_harmonics(torch.from_numpy(offsets / away), splats.bands).numpy()
        total += weight
    colours = np.einsum("nk,nkc->nc", basis / total, splats.harmonics) + np.float32(COLOUR_OFFSET)
    return np.clip(colours, 0.0, 1.0).astype(np.float32)
