"""Removes Gaussians that would spoil a scene, and counts them by reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from advnerf_core.geometry import Array
from advnerf_core.splats.gaussians import GaussianSplats, SplatError
from advnerf_core.splats.projection import LEAST_ALPHA

# A scene reaches as far as all but this share of its Gaussians on each side.
_OUTSIDE = 0.005
_MARGIN = 0.05  # of the longest side, around the box
# Times the longest side of the scene.
_FAR, _WILD = 100.0, 10.0
# A floater's neighbours are farther away than usual and than its own size, by this factor.
_NEIGHBOURS, _ALONE = 8, 10.0
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Removed:
    """Gaussians that were removed for one reason."""

    count: int
    reason: str


def clean(splats: GaussianSplats, floaters: bool = True) -> tuple[GaussianSplats, list[Removed]]:
    """Remove Gaussians with invalid numbers, without opacity, far away, of wild sizes, and those that float alone.

    Args:
        splats: The Gaussians, in any unit.
        floaters: Whether to remove those far from all others.

    Raises:
        SplatError: Fewer than half of them have valid numbers, or none are left.
    """
    removed: list[Removed] = []
    count = len(splats)
    values = (
        splats.means_m,
        splats.scales_m,
        splats.rotations,
        splats.opacities[:, None],
        splats.harmonics.reshape(count, -1),
    )
    finite = np.all([np.isfinite(each).all(axis=1) for each in values], axis=0)
    valid = (
        finite & (splats.scales_m >= 0.0).all(axis=1) & (splats.opacities >= 0.0) & (splats.opacities <= 1.0)
    )
    if valid.sum() < _LEAST_SHARE * count:
        raise SplatError(
            f"expected valid numbers in a splat, got NaN, infinite or impossible ones in {count - int(valid.sum()):,} of {count:,} Gaussians; export it again"
        )
    splats = _without(splats, ~valid, "NaN, infinite or impossible numbers", removed)
    splats = _without(
        splats, splats.opacities < LEAST_ALPHA, "opacity below 1/255, which is never drawn", removed
    )
    low, high = central_box(splats)
    extent, centre = float((high - low).max()), 0.5 * (low + high)
    away = np.abs(splats.means_m - centre).max(axis=1)
    splats = _without(
        splats, away > _FAR * extent, f"centres farther away than {_FAR:g} times the scene's size", removed
    )
    wild = splats.scales_m.max(axis=1) > _WILD * extent
    splats = _without(splats, wild, f"sizes beyond {_WILD:g} times the scene's", removed)
    if floaters and len(splats) > _NEIGHBOURS:
        splats = _without(splats, _alone(splats), "floaters, far from all others", removed)
    return splats, removed


def central_box(splats: GaussianSplats) -> tuple[Array, Array]:
    """Low and high corner ``[3]`` of where nearly all Gaussians are, with a margin."""
    low, high = np.quantile(splats.means_m.astype(np.float64), [_OUTSIDE, 1.0 - _OUTSIDE], axis=0)
    margin = max(_MARGIN * float((high - low).max()), float(np.median(splats.scales_m)), 1e-6)
    return low - margin, high + margin


def _without(
    splats: GaussianSplats, which: NDArray[np.bool_], reason: str, removed: list[Removed]
) -> GaussianSplats:
    if not which.any() and len(splats) > 0:
        return splats
    removed.append(Removed(int(which.sum()), reason))
    if which.all():
        reasons = "; ".join(f"{each.count:,} for {each.reason}" for each in removed)
        raise SplatError(
            f"expected Gaussians that can be drawn, got none after leaving out {reasons}; export it again"
        )
    return splats.chosen(~which)


def _alone(splats: GaussianSplats) -> NDArray[np.bool_]:
    """Whether each Gaussian's neighbours are unusually far away, also for its size."""
    distances, _ = cKDTree(splats.means_m).query(splats.means_m, _NEIGHBOURS + 1, workers=-1)
    farthest = distances[:, -1]
    usual = max(float(np.median(farthest)), 1e-12)
    return np.asarray(farthest > _ALONE * np.maximum(splats.scales_m.max(axis=1), usual))
