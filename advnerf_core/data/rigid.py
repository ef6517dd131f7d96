"""The check of poses that come from files."""

from __future__ import annotations

from typing import Any

import numpy as np

from advnerf_core.geometry import Array

_TOLERANCE = 0.01
# Relative to the spread of the cameras, in any unit: single precision resolves a thousandth of the spread there. Anything farther has
# a map's origin, not a scene's.
_FARTHEST = 1e4
_SPREAD_QUANTILE = 0.9


def rigid_pose(matrix: Any) -> Array:
    """The pose ``[4, 4]`` nearest to numbers ``[3 or 4, 4]``, whose rotation may be rounded to a few digits.

    Raises:
        ValueError: They are no rotation and translation.
    """
    try:
        T = np.array(matrix, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise ValueError(f"expected 4 x 4 numbers, got {matrix!r:.80}") from None
    if T.shape == (3, 4):
        T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
    if T.shape != (4, 4):
        raise ValueError(f"expected 4 x 4 numbers, got shape {list(T.shape)}")
    if not np.isfinite(T).all():
        raise ValueError("expected finite numbers, got NaN or infinity; leave this frame out")
    if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > _TOLERANCE:
        raise ValueError(f"expected the last row 0 0 0 1, got {T[3].tolist()}; is it transposed?")
    u, stretch, vt = np.linalg.svd(T[:3, :3])
    mirrored = np.linalg.det(u @ vt) < 0.0
    if np.abs(stretch - 1.0).max() > _TOLERANCE or mirrored:
        kind = "a mirror image" if mirrored else "a stretch"
        raise ValueError(
            f"expected a rotation and a translation, got {kind} by {', '.join(f'{s:.4g}' for s in stretch)} in its rotation part; "
            "remove the scale of the camera (or of its parent) and export again"
        )
    # The nearest rotation keeps rays of unit length.
    T[:3, :3] = u @ vt
    return T


def far_from_origin(places: Array) -> tuple[int, str] | None:
    """The camera ``[N, 3]`` that lies farther from the origin than single precision allows, and the problem in words; None if all are near."""
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    spread = float(np.quantile(away, _SPREAD_QUANTILE, method="lower"))
    farthest = int(np.abs(places).max(axis=1).argmax())
    value = float(np.abs(places[farthest]).max())
    if spread <= 0.0 or value <= _FARTHEST * spread:
        return None
    return farthest, (
        f"expected a camera within {_FARTHEST:.0f} times the spread of the cameras, {spread:.4g}, of the origin, got {value:.4g}; "
        "take a common offset off all positions (map coordinates have a far origin), or leave the frame out"
    )
