"""Light baked into the room's surfaces: soft shadows of the furniture under the ceiling's lamps.

The room is static and matte, so its light is the same from everywhere; computing it once costs half a second and makes a
frame several times cheaper than drawing shadow maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from advnerf_core.geometry import Array
from hardware.worlds.lab.furniture import Solid

AMBIENT = 0.56  # share of light scattered so often that it is uniform
LAMP_POWER = 11.0  # all lamps together [m2]: a floor point under a lamp gets about 1 in all


def lamp_samples(room_half_m: float, room_height_m: float) -> Array:
    """Points ``[S, 3]`` on the four lamps under the ceiling [m]."""
    spread = 0.45 * room_half_m
    lamps = [(a * spread, b * spread) for a in (-1, 1) for b in (-1, 1)]
    offsets = [(u * 0.35, v * 0.2) for u in (-1, 1) for v in (-1, 1)]
    return np.array([(x + u, y + v, room_height_m - 0.03) for x, y in lamps for u, v in offsets])


def irradiance(points_m: Array, normal: Array, lamps_m: Array, occluders: Sequence[Solid]) -> Array:
    """Relative light on surface points: ambient plus the lamps that they see.

    ``E = ambient + k sum_s V_s cos(theta_surface) cos(theta_lamp) / r^2``, with k such that a floor point straight under
    one lamp's middle gets about 1 in all.

    Args:
        points_m: Surface points ``[N, 3]`` [m].
        normal: Common outward unit normal ``[3]`` of the surface.
        lamps_m: Lamp points ``[S, 3]``, radiating downwards [m].
        occluders: Solids that cast shadows.

    Returns:
        Relative irradiance ``[N]``.
    """
    start = np.asarray(points_m, dtype=np.float32) + 0.01 * np.asarray(normal, dtype=np.float32)
    ray = np.asarray(lamps_m, dtype=np.float32)[None] - start[:, None]  # [N, S, 3]
    squared = np.einsum("nsk,nsk->ns", ray, ray)
    facing = np.clip(ray @ np.asarray(normal, dtype=np.float32), 0.0, None)
    light = facing * np.clip(ray[..., 2], 0.0, None) / squared**2
    visible = np.ones(light.shape, dtype=bool)
    for solid in occluders:
        visible &= ~_blocked(start, ray, solid)
    scale = LAMP_POWER / len(lamps_m)
    return (AMBIENT + scale * (light * visible).sum(axis=1)).astype(np.float64)


def _blocked(start: np.ndarray, ray: np.ndarray, solid: Solid) -> np.ndarray:
    """Whether the segments ``start + t ray, 0 < t < 1`` meet a solid's box, ``[N, S]`` (slab test)."""
    c, s = math.cos(solid.yaw_rad), math.sin(solid.yaw_rad)
    to_local = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=np.float32)
    # A cylinder or ellipsoid is rounder than its box; a slightly smaller box stands in for it.
    shrink = 1.0 if solid.kind == "box" else 0.88
    half = np.asarray(solid.half_m, dtype=np.float32) * shrink
    origin = (start - np.asarray(solid.centre_m, dtype=np.float32)) @ to_local.T
    step = ray @ to_local.T
    enter = np.zeros(step.shape[:2], dtype=np.float32)
    leave = np.ones(step.shape[:2], dtype=np.float32)
    for axis in range(3):
        inverse = 1.0 / np.where(np.abs(step[..., axis]) < 1e-7, np.float32(1e-7), step[..., axis])
        near = (-half[axis] - origin[:, None, axis]) * inverse
        far = (half[axis] - origin[:, None, axis]) * inverse
        np.maximum(enter, np.minimum(near, far), out=enter)
        np.minimum(leave, np.maximum(near, far), out=leave)
    return enter < leave
