"""Tells photographs of a camera that only turned from those of one that was moved, before poses are looked for.

Structure from motion takes the noise of such photographs for parallax: poses, lens and scale of its model are then invented, or it finds
hardly any photograph that fits. Between two views of a camera that only turned by ``R``, rays are related by ``r_2 = R r_1`` whatever
the depth (Hartley and Zisserman 2004, section 8.4); a camera that was moved leaves parallax, also before a flat wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from advnerf_core.geometry import Array

# Focal lengths in longer sides of the image, from wide lenses to those of phones. Of longer ones rotation and shift look alike.
_FOCAL_LENGTHS = np.geomspace(0.4, 1.7, 13)
# Measured: from one place all pairs agree within 0.0013 (the true focal length lies between two of these), before a flat wall 9 % within 0.003.
_AGREES = 0.004  # median error of a pair's matches, in longer sides of the image
_LEAST_SHARE = 0.9  # of the pairs
_LEAST_PAIRS, _MOST_PAIRS = 5, 200


@dataclass(frozen=True)
class Turned:
    """How well pure rotation explains the matches of photographs.

    Attributes:
        pairs: Pairs of photographs that were looked at.
        share: Share of them whose matches a rotation explains.
    """

    pairs: int
    share: float

    @property
    def only(self) -> bool:
        """Whether the camera only turned."""
        return self.pairs >= _LEAST_PAIRS and self.share >= _LEAST_SHARE


def turned(matches: Sequence[tuple[Array, Array]]) -> Turned:
    """How well rotations with one focal length explain matches.

    Args:
        matches: Of each pair of photographs, the places of the same points in both ``[N, 2]`` each, from the middle of the image in longer sides.
    """
    chosen = [
        matches[k]
        for k in np.unique(np.linspace(0, len(matches) - 1, min(len(matches), _MOST_PAIRS)).astype(int))
    ]
    if not chosen:
        return Turned(0, 0.0)
    errors = [[_error_of_rotation(one, other, focal) for one, other in chosen] for focal in _FOCAL_LENGTHS]
    return Turned(len(chosen), float((np.array(errors) < _AGREES).mean(axis=1).max()))


def _error_of_rotation(first: Array, second: Array, focal: float) -> float:
    """Median error of the best rotation between two views, in longer sides of the image."""
    one, other = _rays(first, focal), _rays(second, focal)
    left, _, right = np.linalg.svd(other.T @ one)
    R = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return float(np.median(np.linalg.norm(other - one @ R.T, axis=1)) * focal)


def _rays(points: Array, focal: float) -> Array:
    rays = np.column_stack([points / focal, np.ones(len(points))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
