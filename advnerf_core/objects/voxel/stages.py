"""Coarse-to-fine fits: a small grid finds the shape in cheap steps, and each finer grid starts from the one before."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from advnerf_core.objects.voxel.fit import LEARNING_RATE, Fit, fit_grids
from advnerf_core.objects.voxel.hull import visual_hull
from advnerf_core.objects.voxel.pictures import PosedRgba
from advnerf_core.objects.voxel.voxelise import OPAQUE_PER_VOXEL, ObjectGrids

_COARSEST = 32
# Share of the steps or of the time of the last stage, which matters most.
_LAST_SHARE = 0.6
# A grid that starts from a fit needs no large steps: they tear thin voxels open, which no ray closes again.
_REFINING = 0.15


def resolutions(finest: int) -> list[int]:
    """List the grids of a coarse-to-fine fit: each has twice the voxels per side of the one before, from 32 or more."""
    sizes = [finest]
    while sizes[0] >= 2 * _COARSEST:
        sizes.insert(0, -(-sizes[0] // 2))
    return sizes


def stage_shares(count: int) -> list[float]:
    """Share of the steps or of the time that each of ``count`` stages gets; the sum is 1, and each gets more than the one before."""
    if count == 1:
        return [1.0]
    before = [2.0**stage for stage in range(count - 1)]
    return [(1.0 - _LAST_SHARE) * part / sum(before) for part in before] + [_LAST_SHARE]


def resampled(grids: ObjectGrids, onto: ObjectGrids) -> ObjectGrids:
    """Interpolate density and colours at the voxel centres of another grid.

    Density is interpolated relative to an opaque voxel's, so that it does not depend on the size of the voxels. Voxels stay empty
    where the other grid has no density within two voxels.
    """
    axes = [
        (low + onto.voxel * (np.arange(count) + 0.5) - start) / grids.voxel - 0.5
        for low, start, count in zip(onto.box_min, grids.box_min, onto.density.shape, strict=True)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"))

    def at_places(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(ndimage.map_coordinates(values, places, order=1, mode="nearest"), np.float32)

    share = at_places(grids.density * np.float32(grids.voxel / OPAQUE_PER_VOXEL))
    near = ndimage.binary_dilation(onto.density > 0.0, np.ones((3, 3, 3)), iterations=2)
    share = np.where(near, share, 0.0)
    colours = np.stack([at_places(grids.colours[..., channel]) for channel in range(3)], axis=-1)
    density = (share * (OPAQUE_PER_VOXEL / onto.voxel)).astype(np.float32)
    return ObjectGrids(density, colours, onto.box_min, onto.box_max)


def fit_in_stages(
    views: PosedRgba,
    resolution: int,
    steps: int,
    progress: Callable[[float, str], None] | None = None,
    max_seconds: float | None = None,
) -> Fit:
    """Carve the visual hull and fit it on finer and finer grids.

    Args:
        resolution: Voxels along the longest side at the end.
        steps: Optimiser steps over all stages.
        max_seconds: Stop after this much time, if sooner [s]. Time that a stage does not use goes to the later ones.
    """
    sizes = resolutions(resolution)
    shares = stage_shares(len(sizes))
    began, done = time.monotonic(), 0.0
    fit: Fit | None = None
    taken = 0
    for size, share in zip(sizes, shares, strict=True):
        start = visual_hull(views, size)
        if fit is not None:
            start = resampled(fit.grids, start)
        left = None if max_seconds is None else max_seconds - (time.monotonic() - began)
        fit = fit_grids(
            views,
            start,
            max(1, round(share * steps)),
            progress=_part(progress, done, share),
            max_seconds=None if left is None else max(left, 1e-3) * share / (1.0 - done),
            learning_rate=LEARNING_RATE if fit is None else _REFINING * LEARNING_RATE,
        )
        done, taken = done + share, taken + fit.steps
    assert fit is not None
    return Fit(fit.grids, taken, fit.gain_db)


def _part(
    progress: Callable[[float, str], None] | None, done: float, share: float
) -> Callable[[float, str], None] | None:
    """Converts the progress of one stage to the progress of the whole fit."""
    if progress is None:
        return None
    return lambda fraction, text: progress(min(1.0, done + share * fraction), text)
