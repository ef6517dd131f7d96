"""Cameras around an object, for fitting, judging and showing it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import Array, Pinhole, look_at

FIELD_OF_VIEW_RAD = np.deg2rad(35.0)
# Elevations of the cameras of a ring, and of a dome.
_RING_RAD, _LOWEST_RAD, _HIGHEST_RAD = 0.25, -0.1, 1.1


def viewing_lens(pixels: int) -> Pinhole:
    """Lens of a square picture of 35 degrees."""
    f = 0.5 * pixels / np.tan(FIELD_OF_VIEW_RAD / 2)
    return Pinhole(pixels, pixels, f, f, pixels / 2, pixels / 2)


def ring(box: tuple[Array, Array], count: int) -> Array:
    """Poses ``[count, 4, 4]`` on a circle around a box, with the box in view."""
    azimuth = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return _poses(box, azimuth, np.full(count, _RING_RAD, dtype=np.float64))


def dome(box: tuple[Array, Array], count: int, phase: float = 0.0) -> Array:
    """Poses ``[count, 4, 4]`` spread evenly over the part of a sphere visible to a car's camera and a person (a golden spiral)."""
    k = (np.arange(count) + 0.5) / count
    sine = np.sin(_LOWEST_RAD) + k * (np.sin(_HIGHEST_RAD) - np.sin(_LOWEST_RAD))
    azimuth = 2.0 * np.pi * ((np.arange(count) + phase) * 0.6180339887498949 % 1.0)
    return _poses(box, azimuth, np.asarray(np.arcsin(sine), dtype=np.float64))


def _poses(box: tuple[Array, Array], azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    low, high = box
    azimuth, elevation = np.asarray(azimuth), np.asarray(elevation)
    centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    distance = 1.05 * radius / np.sin(FIELD_OF_VIEW_RAD / 2)
    ray = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )
    return np.stack([look_at(centre + distance * direction, centre) for direction in ray])
