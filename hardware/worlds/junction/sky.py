"""The backdrop around the town: a painted sky with soft clouds, hills and treetops, as colours of directions.

The colour depends on the direction from the junction's middle alone, so the panels of the backdrop meet without a seam.
"""

from __future__ import annotations

import math

import numpy as np

from advnerf_core.geometry import Array
from hardware.worlds.junction.config import RoadConfig
from hardware.worlds.lab.surfaces import EAST, NORTH, UP, Surface
from hardware.worlds.lab.textures import Image

EYE_M = 1.5  # height from which the horizon is level
_PIXELS_PER_M = 6.0
_HAZE: Array = np.array([0.80, 0.86, 0.91])


def backdrop(road: RoadConfig, rng: np.random.Generator) -> list[Surface]:
    """The four sides and the ceiling of the world, seen from inside."""
    half, high = road.half_m, road.sky_m
    phases = rng.uniform(0.0, 2.0 * math.pi, (2, 7))
    panels = []
    for name, inward in (("south", NORTH), ("east", -EAST), ("north", -NORTH), ("west", EAST)):
        right = np.asarray(np.cross(UP, inward), dtype=np.float64)
        panels.append((f"sky_{name}", 0.5 * high * UP - half * inward, right, UP, (half, 0.5 * high)))
    panels.append(("sky_top", high * UP, EAST, -NORTH, (half, half)))
    return [Surface(*panel, image=_paint(*panel[1:], road, phases)) for panel in panels]


def _paint(
    centre: Array, right: Array, up: Array, half_m: tuple[float, float], road: RoadConfig, phases: Array
) -> Image:
    # The ceiling is plain blue with clouds; only the sides carry a horizon.
    per_m = _PIXELS_PER_M if up[2] > 0.0 else 0.25 * _PIXELS_PER_M
    columns, rows = (round(2.0 * half * per_m) for half in half_m)
    u = ((np.arange(columns) + 0.5) / columns * 2.0 - 1.0) * half_m[0]
    v = (1.0 - (np.arange(rows) + 0.5) / rows * 2.0) * half_m[1]
    points = centre + u[None, :, None] * right + v[:, None, None] * up - EYE_M * UP
    direction = points / np.linalg.norm(points, axis=-1, keepdims=True)
    rgb = _air(direction, phases[0])
    azimuth = np.arctan2(direction[..., 1], direction[..., 0])
    elevation = np.degrees(np.arcsin(direction[..., 2]))
    hills = 4.2 + 1.6 * _waves(azimuth, (1, 2, 3, 5), phases[1])
    trees = 2.4 + 0.7 * _waves(azimuth, (4, 7, 11, 19), phases[1, ::-1])
    rgb = _over(rgb, (0.58, 0.66, 0.68), hills - elevation)
    rgb = _over(rgb, (0.44, 0.54, 0.42), trees - elevation)
    ground = _far_ground(direction, road)
    return np.asarray(np.where(elevation[..., None] < 0.0, ground, rgb), dtype=np.float32)


def _waves(azimuth: Array, counts: tuple[int, ...], phases: Array) -> Array:
    """A sum of whole waves round the horizon, about -1..1."""
    total = sum(np.cos(count * azimuth + phase) for count, phase in zip(counts, phases, strict=False))
    return np.asarray(total / math.sqrt(0.5 * len(counts)) * 0.6, dtype=np.float64)


def _over(rgb: Array, colour: tuple[float, float, float], inside_deg: Array) -> Array:
    """Paint a colour where ``inside_deg`` is positive, with an edge half a degree wide."""
    alpha = np.clip(inside_deg / 0.5 + 0.5, 0.0, 1.0)[..., None]
    return np.asarray(rgb + alpha * (np.array(colour) - rgb), dtype=np.float64)


def _air(direction: Array, phases: Array) -> Array:
    """Blue that deepens upwards, with soft clouds that grow smaller towards the horizon."""
    up = np.clip(direction[..., 2], 0.0, 1.0)
    rgb = _HAZE + (np.array([0.36, 0.57, 0.86]) - _HAZE) * np.sqrt(up)[..., None]
    flat = direction[..., :2] / (up + 0.30)[..., None]
    total = np.zeros(up.shape)
    for index, phase in enumerate(phases):
        angle, rate = 2.4 * index + 0.3, 2.2 + 0.9 * index
        total += np.cos(rate * (math.cos(angle) * flat[..., 0] + math.sin(angle) * flat[..., 1]) + phase)
    cloud = np.clip((total / math.sqrt(0.5 * len(phases)) - 0.35) / 1.3, 0.0, 1.0)
    cloud = cloud * cloud * (3.0 - 2.0 * cloud) * np.clip(up / 0.12, 0.0, 1.0)
    return np.asarray(rgb + 0.85 * cloud[..., None] * (np.array([0.97, 0.97, 0.98]) - rgb), dtype=np.float64)


def _far_ground(direction: Array, road: RoadConfig) -> Array:
    """Roads and fields beyond the end of the world, as seen from the junction's middle, paler with the distance."""
    distance = EYE_M / np.maximum(-direction[..., 2], 1e-3)
    x, y = direction[..., 0] * distance, direction[..., 1] * distance
    width = road.lane_width_m
    on_road = (np.abs(y) < width) | ((np.abs(x) < width) & (y < 0.0))
    rgb = np.where(on_road[..., None], np.array([0.41, 0.41, 0.41]), np.array([0.40, 0.51, 0.32]))
    haze = 1.0 - np.exp(-distance / 160.0)
    return np.asarray(rgb + haze[..., None] * (np.array([0.58, 0.65, 0.62]) - rgb), dtype=np.float64)
