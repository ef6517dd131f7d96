"""Objects without a file: a fire hydrant and a small car, built from turned and extruded outlines."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import Array
from advnerf_core.objects.voxel.mesh import MeshPart, SurfaceMesh, part_from_colours

_RED, _YELLOW, _DARK = (0.72, 0.10, 0.08), (0.86, 0.70, 0.15), (0.10, 0.10, 0.11)
_PAINT, _GLASS, _TYRE, _RIM = (0.20, 0.36, 0.62), (0.13, 0.16, 0.19), (0.07, 0.07, 0.07), (0.62, 0.63, 0.65)
_LAMP, _BRAKE_LAMP, _BUMPER = (0.95, 0.93, 0.80), (0.75, 0.05, 0.05), (0.22, 0.23, 0.25)


def hydrant() -> SurfaceMesh:
    """A fire hydrant: eight-sided barrel with flanges and bonnet, two hose caps and a pumper cap to the front (x)."""
    barrel = [
        (0.0, 0.0),
        (0.19, 0.0),
        (0.19, 0.05),
        (0.125, 0.06),
        (0.115, 0.52),
        (0.17, 0.53),
        (0.17, 0.57),
        (0.14, 0.58),
    ]
    bonnet = [(0.14, 0.58), (0.125, 0.64), (0.085, 0.69), (0.045, 0.71)]
    nut = [(0.045, 0.71), (0.04, 0.75), (0.0, 0.75)]
    hose = [
        (0.0, 0.0),
        (0.055, 0.0),
        (0.055, 0.075),
        (0.072, 0.08),
        (0.072, 0.115),
        (0.03, 0.12),
        (0.025, 0.15),
        (0.0, 0.15),
    ]
    pumper = [(1.35 * r, 0.95 * z) for r, z in hose]
    parts = [
        _turned(barrel, 8, _RED),
        _turned(bonnet, 8, _RED),
        _turned(nut, 5, _DARK),
        _moved(_turned(pumper, 12, _YELLOW), _along((1, 0, 0)), (0.09, 0.0, 0.40)),
        _moved(_turned(hose, 12, _YELLOW), _along((0, 1, 0)), (0.0, 0.09, 0.43)),
        _moved(_turned(hose, 12, _YELLOW), _along((0, -1, 0)), (0.0, -0.09, 0.43)),
    ]
    return SurfaceMesh(tuple(parts))


def small_car() -> SurfaceMesh:
    """A small car that looks along x: body, cabin with windows, four wheels, lamps; wheels on z = 0."""
    half = 0.80
    body = [
        (-1.75, 0.32),
        (1.70, 0.32),
        (1.80, 0.45),
        (1.72, 0.78),
        (0.95, 0.92),
        (-1.72, 0.98),
        (-1.80, 0.50),
    ]
    cabin = [(1.00, 0.88), (0.30, 1.42), (-1.20, 1.46), (-1.70, 0.95)]
    glass = [(0.86, 0.93), (0.27, 1.36), (-1.17, 1.39), (-1.55, 0.98)]
    windscreen = [(1.01, 0.90), (0.36, 1.385), (0.33, 1.36), (0.94, 0.89)]
    rear_window = [(-1.66, 1.00), (-1.70, 1.00), (-1.28, 1.41), (-1.24, 1.41)]
    parts = [
        _extruded(body, half, _PAINT),
        _extruded(cabin, 0.68, _PAINT),
        _extruded(glass, 0.69, _GLASS),
        _extruded(windscreen, 0.60, _GLASS),
        _extruded(rear_window, 0.58, _GLASS),
        _box((1.77, 0.0, 0.42), (0.10, 1.50, 0.14), _BUMPER),
        _box((-1.77, 0.0, 0.42), (0.10, 1.50, 0.14), _BUMPER),
    ]
    for side in (-1.0, 1.0):
        parts.append(_box((1.74, side * 0.62, 0.68), (0.08, 0.26, 0.12), _LAMP))
        parts.append(_box((-1.755, side * 0.66, 0.78), (0.06, 0.18, 0.16), _BRAKE_LAMP))
        for x in (-1.12, 1.15):
            parts += _wheel((x, side * 0.72, 0.30), side)
    return SurfaceMesh(tuple(parts))


GENERATORS: dict[str, Callable[[], SurfaceMesh]] = {"hydrant": hydrant, "car": small_car}
"""What ``advnerf scene object build --generate`` knows."""


def _wheel(centre: ArrayLike, side: float) -> list[MeshPart]:
    tyre = [(0.0, -0.11), (0.26, -0.11), (0.30, -0.08), (0.30, 0.08), (0.26, 0.11), (0.0, 0.11)]
    rim = [(0.17, 0.112), (0.15, 0.12), (0.0, 0.12)]
    turn = _along((0, side, 0))
    return [_moved(_turned(tyre, 24, _TYRE), turn, centre), _moved(_turned(rim, 16, _RIM), turn, centre)]


def _turned(profile: list[tuple[float, float]], sides: int, rgb: ArrayLike) -> MeshPart:
    """The surface that a profile of radius and height sweeps around the z axis."""
    angle = 2.0 * np.pi * np.arange(sides + 1) / sides
    r, z = np.array(profile).T
    rings = np.stack(
        [r[:, None] * np.cos(angle), r[:, None] * np.sin(angle), np.repeat(z[:, None], sides + 1, 1)], -1
    )
    return part_from_colours(*_painted(_strip(rings), rgb))


def _extruded(outline: list[tuple[float, float]], half_width: float, rgb: ArrayLike) -> MeshPart:
    """A convex outline in x and z, as wide as twice ``half_width`` along y, closed at both sides."""
    x, z = np.array([*outline, outline[0]]).T
    left, right = (np.stack([x, np.full_like(x, side * half_width), z], axis=-1) for side in (1.0, -1.0))
    sides = [
        np.stack([edge[[0] * (len(edge) - 3)], edge[1:-2], edge[2:-1]], axis=1) for edge in (left, right)
    ]
    return part_from_colours(*_painted(np.concatenate([_strip(np.stack([left, right])), *sides]), rgb))


def _box(centre: ArrayLike, size: ArrayLike, rgb: ArrayLike) -> MeshPart:
    a, b, c = 0.5 * np.asarray(size, dtype=np.float64)
    part = _extruded([(-a, -c), (a, -c), (a, c), (-a, c)], float(b), rgb)
    return _moved(part, np.eye(3), centre)


def _strip(rings: Array) -> Array:
    """Triangles ``[F, 3, 3]`` between neighbouring rows of points ``[R, S, 3]``."""
    a, b, c, d = rings[:-1, :-1], rings[:-1, 1:], rings[1:, :-1], rings[1:, 1:]
    return np.concatenate(
        [np.stack([a, b, d], axis=2).reshape(-1, 3, 3), np.stack([a, d, c], axis=2).reshape(-1, 3, 3)]
    )


def _painted(triangles: Array, rgb: ArrayLike) -> tuple[Array, Array]:
    return triangles, np.broadcast_to(np.asarray(rgb, dtype=np.float64), (len(triangles), 3))


def _along(axis: ArrayLike) -> Array:
    """A rotation that takes z to a horizontal axis."""
    z = np.asarray(axis, dtype=np.float64)
    y = np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(y, z), y, z], axis=1)


def _moved(part: MeshPart, rotation: Array, offset: ArrayLike) -> MeshPart:
    return MeshPart(part.triangles @ rotation.T + np.asarray(offset, dtype=np.float64), part.uv, part.texture)
