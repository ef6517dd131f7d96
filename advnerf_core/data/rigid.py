"""The check of poses that come from files."""

from __future__ import annotations

from typing import Any

import numpy as np

from advnerf_core.geometry import Array

_TOLERANCE = 0.01


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
