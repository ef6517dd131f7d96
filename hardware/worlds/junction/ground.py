"""Pavements, gardens and the white paint on the roads, from the road's measures."""

from __future__ import annotations

import math

import numpy as np

from advnerf_core.geometry import Array
from hardware.worlds.junction.config import RoadConfig
from hardware.worlds.junction.solids import TexturedSolid, fan, joined, strip, wall

KERB_M = 0.2  # width of the kerb stones
PAINT_M = 0.01  # height of the markings above the asphalt, so that they win against it at every distance
CORNER_STEPS = 16


def kerb_lines(road: RoadConfig, inset_m: float) -> dict[str, Array]:
    """Lines ``[N, 2]`` [m] around the blocks of houses "north", "west" (south-west) and "east" (south-east).

    They run with the roads on their right, ``inset_m`` away from the asphalt; lines of different inset have as many points,
    across from each other.
    """
    width, half, radius = road.lane_width_m, road.half_m, road.corner_radius_m
    centre, reach = width + radius, radius - inset_m
    # From the corner's east (the side road's kerb) to its north (the main road's kerb).
    angles = np.linspace(0.0, 0.5 * math.pi, CORNER_STEPS + 1)
    corner = np.c_[-centre + reach * np.cos(angles), -centre + reach * np.sin(angles)]
    edge = width + inset_m
    west = np.concatenate([[(-edge, -half)], corner, [(-half, -edge)]])
    return {"north": np.array([(-half, edge), (half, edge)]), "west": west, "east": west[::-1] * (-1.0, 1.0)}


def ground(road: RoadConfig, kerb_u: float) -> dict[str, TexturedSolid]:
    """The raised ground by picture: "pavement", "garden", and the "swatches" of the kerb stones."""
    half, top = road.half_m, road.kerb_height_m
    asphalt, stone, inner = (kerb_lines(road, inset) for inset in (0.0, KERB_M, road.pavement_width_m))
    pavements, gardens, kerbs = [], [], []
    far = {"north": (0.0, 1e3), "west": (-half, -half), "east": (half, -half)}
    for name, line in asphalt.items():
        kerbs.append(wall(line, 0.0, top, kerb_u, tone=0.9))
        flat = strip(stone[name], line, top, half)
        kerbs.append(TexturedSolid(flat.vertices, flat.faces, np.tile([kerb_u, 0.90], (len(flat.uv), 1))))
        pavements.append(strip(inner[name], stone[name], top, half))
        if name != "north":
            gardens.append(fan(far[name], inner[name], top, half))
    edge = inner["north"]
    gardens.append(strip(np.array([(-half, half), (half, half)]), edge, top, half))
    return {"pavement": joined(pavements), "garden": joined(gardens), "swatches": joined(kerbs)}


def markings(road: RoadConfig) -> list[Array]:
    """Everything painted white on the asphalt, as convex polygons ``[N, 2]`` [m], counter-clockwise."""
    width, half = road.lane_width_m, road.half_m
    mouth = width + road.corner_radius_m  # where the rounded corners begin
    pieces = []
    for sign in (-1.0, 1.0):  # centre line of the main road: unbroken near the junction, then dashes
        pieces.append(_along_x(sign * (mouth + 4.2), sign * (mouth + 13.2), 0.0, 0.15))
        pieces += [
            _along_x(sign * s, sign * (s + 3.0), 0.0, 0.15)
            for s in np.arange(mouth + 15.7, half - 1.0, 6.0).tolist()
        ]
    pieces.append(_along_y(-mouth - 4.4, -mouth - 14.4, 0.0, 0.15))
    pieces += [_along_y(-s, -s - 3.0, 0.0, 0.15) for s in np.arange(mouth + 16.9, half - 1.0, 6.0).tolist()]
    dashes = np.arange(-mouth + 1.2, mouth - 1.7, 1.2).tolist()
    pieces += [_along_x(x, x + 0.6, -width + 0.05, 0.25) for x in dashes]  # give-way line
    pieces.append(_along_y(-mouth - 4.2, -mouth - 4.6, 0.5 * width, width - 0.3))  # stop line
    stripes = np.arange(-width + 0.45, width - 0.3, 1.0).tolist()
    pieces += [
        _along_y(-mouth - 0.6, -mouth - 3.4, x + 0.05, 0.5) for x in stripes
    ]  # zebra over the side road
    pieces += [
        _along_x(-mouth - 0.6, -mouth - 3.4, y + 0.05, 0.5) for y in stripes
    ]  # zebra over the west arm
    for x, y, yaw in ((-mouth - 10.0, -0.5 * width, 0.0), (0.5 * width, -mouth - 10.5, 0.5 * math.pi)):
        pieces += _arrow(x, y, yaw)
    return pieces


def _along_x(x0: float, x1: float, y: float, width: float) -> Array:
    low, high, half = min(x0, x1), max(x0, x1), 0.5 * width
    return np.array([(low, y - half), (high, y - half), (high, y + half), (low, y + half)])


def _along_y(y0: float, y1: float, x: float, width: float) -> Array:
    low, high, half = min(y0, y1), max(y0, y1), 0.5 * width
    return np.array([(x - half, low), (x + half, low), (x + half, high), (x - half, high)])


def _arrow(x: float, y: float, yaw: float) -> list[Array]:
    """An arrow on the road that points along ``yaw``."""
    c, s = math.cos(yaw), math.sin(yaw)
    shaft = np.array([(-2.0, -0.1), (0.6, -0.1), (0.6, 0.1), (-2.0, 0.1)])
    head = np.array([(0.6, -0.4), (2.0, 0.0), (0.6, 0.4)])
    return [part @ np.array([(c, s), (-s, c)]) + (x, y) for part in (shaft, head)]
