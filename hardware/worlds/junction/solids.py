"""Triangles for everything that is not a flat picture: strips of ground, roofs, trees, posts, markings.

A piece of geometry carries its picture coordinates ``uv`` in 0..1, u to the right and v up. Solids take their colour from
the swatches: u picks the colour and v its brightness, so that a different tone needs no extra picture.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import Array

Faces = NDArray[np.int32]

# The sky lights everything alike, the sun (a unit vector towards it) what faces it: matte, the same from every side.
SUN: Array = np.array([-0.32, -0.42, 0.85]) / math.hypot(0.32, 0.42, 0.85)
SKY_LIGHT, SUN_LIGHT = 0.62, 0.48
BRIGHTEST = 1.15  # brightness at v = 1; it is 0 at v = 0


def shade(normal: ArrayLike) -> Array:
    """Brightness ``[...]`` of matte surfaces with unit normals ``[..., 3]`` in sun and sky."""
    return np.asarray(SKY_LIGHT + SUN_LIGHT * np.maximum(np.asarray(normal) @ SUN, 0.0), dtype=np.float64)


@dataclass(frozen=True)
class TexturedSolid:
    """Triangles with picture coordinates.

    Attributes:
        vertices: Corners ``[N, 3]`` [m].
        faces: Corners of the triangles ``[M, 3]``, counter-clockwise from outside.
        uv: Picture coordinates ``[N, 2]``.
    """

    vertices: Array
    faces: Faces
    uv: Array


def joined(solids: Sequence[TexturedSolid]) -> TexturedSolid:
    """All of them as one."""
    firsts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    return TexturedSolid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate(
            [solid.faces + first for solid, first in zip(solids, firsts[:-1], strict=True)]
        ).astype(np.int32),
        np.concatenate([solid.uv for solid in solids]),
    )


def plan_uv(vertices: Array, half_m: float) -> Array:
    """Picture coordinates ``[N, 2]`` of points on a plan of the whole world seen from above, north on top."""
    return np.asarray(vertices[:, :2] / (2.0 * half_m) + 0.5, dtype=np.float64)


def strip(left: Array, right: Array, z_m: float, half_m: float) -> TexturedSolid:
    """Level ground between two lines ``[N, 2]`` of points across from each other, ``left`` to the left of the way along them."""
    count = len(left)
    i = np.arange(count - 1)
    vertices = np.c_[np.concatenate([left, right]), np.full(2 * count, z_m)]
    faces = np.concatenate([np.c_[i, i + count, i + count + 1], np.c_[i, i + count + 1, i + 1]]).astype(
        np.int32
    )
    return TexturedSolid(vertices, faces, plan_uv(vertices, half_m))


def fan(middle: tuple[float, float], line: Array, z_m: float, half_m: float) -> TexturedSolid:
    """Level ground between one point and a line ``[N, 2]`` that runs counter-clockwise round it."""
    count = len(line)
    vertices = np.c_[np.concatenate([[middle], line]), np.full(count + 1, z_m)]
    i = np.arange(1, count)
    return TexturedSolid(
        vertices, np.c_[np.zeros_like(i), i, i + 1].astype(np.int32), plan_uv(vertices, half_m)
    )


def polygon(corners: ArrayLike, uv: ArrayLike) -> TexturedSolid:
    """A flat convex polygon of corners ``[N, 3]``, counter-clockwise for the viewer."""
    points = np.asarray(corners, dtype=np.float64)
    i = np.arange(1, len(points) - 1)
    faces = np.c_[np.zeros_like(i), i, i + 1].astype(np.int32)
    return TexturedSolid(
        points, faces, np.broadcast_to(np.asarray(uv, dtype=np.float64), (len(points), 2)).copy()
    )


def wall(line: Array, low_m: float, high_m: float, u: float, tone: float = 1.0) -> TexturedSolid:
    """An upright band under a line ``[N, 2]``, seen from its right; one swatch, lit by its own direction."""
    parts = []
    for a, b in itertools.pairwise(line):
        along = (b - a) / np.linalg.norm(b - a)
        v = tone * float(shade([along[1], -along[0], 0.0])) / BRIGHTEST
        parts.append(polygon([(*a, low_m), (*b, low_m), (*b, high_m), (*a, high_m)], (u, v)))
    return joined(parts)


def block(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], u: float) -> TexturedSolid:
    """A box without its floor."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    around = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])
    top = polygon(
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)], (u, float(shade([0, 0, 1])) / BRIGHTEST)
    )
    return joined([wall(around, z0, z1, u), top])


def post(
    x_m: float, y_m: float, z: tuple[float, float], radius_m: float, u: float, sides: int = 8
) -> TexturedSolid:
    """An upright cylinder without ends."""
    angles = np.linspace(0.0, 2.0 * math.pi, sides + 1)
    around = np.c_[x_m + radius_m * np.cos(angles), y_m + radius_m * np.sin(angles)]
    return wall(around, *z, u)


def crown(
    centre: tuple[float, float, float], radii: tuple[float, float], u: float, rng: np.random.Generator
) -> TexturedSolid:
    """A tree's crown: an uneven ellipsoid (radius across, radius up), light where the sun is, blotched like leaves."""
    rings, sides = 9, 14
    latitude, longitude = np.meshgrid(
        np.linspace(-0.5 * math.pi, 0.5 * math.pi, rings),
        np.linspace(0.0, 2.0 * math.pi, sides, endpoint=False),
        indexing="ij",
    )
    normal = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)],
        axis=-1,
    ).reshape(-1, 3)
    bumps = 1.0 + 0.09 * rng.standard_normal(len(normal))
    vertices = np.asarray(centre) + normal * (radii[0], radii[0], radii[1]) * bumps[:, None]
    # Leaves shade each other: less light from below, and no hard edge between sun and shadow.
    light = 0.66 + 0.22 * normal[:, 2] + 0.24 * (normal @ SUN)
    v = np.clip(light + 0.07 * rng.standard_normal(len(normal)), 0.3, 1.1) / BRIGHTEST
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + j).ravel(), (i * sides + (j + 1) % sides).ravel()
    faces = np.concatenate([np.c_[a, b, b + sides], np.c_[a, b + sides, a + sides]]).astype(np.int32)
    return TexturedSolid(vertices, faces, np.c_[np.full(len(v), u), v])


def gable(
    x: tuple[float, float],
    y: tuple[float, float],
    eaves_m: float,
    ridge_m: float,
    u: float,
    wall_u: float,
    along_x: bool,
) -> list[TexturedSolid]:
    """A pitched roof with its two gable walls.

    Args:
        x: Extent of the house [m].
        y: Extent of the house [m].
        eaves_m: Height where the roof begins [m].
        ridge_m: Height of the ridge [m].
        u: Swatch of the tiles.
        wall_u: Swatch of the gables.
        along_x: Whether the ridge runs along x, else along y.
    """
    over, (x0, x1), (y0, y1) = 0.35, x, y
    corners = (
        [(x0, y0), (x1, y0), (x1, y1), (x0, y1)] if along_x else [(x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    )
    middle = 0.5 * (y0 + y1) if along_x else 0.5 * (x0 + x1)
    half = 0.5 * (y1 - y0) if along_x else 0.5 * (x1 - x0)
    ridge = (
        [(x1, middle, ridge_m), (x0, middle, ridge_m)]
        if along_x
        else [(middle, y1, ridge_m), (middle, y0, ridge_m)]
    )
    slope = (ridge_m - eaves_m) / half
    low = eaves_m - slope * over
    solids = []
    for first, ends in ((0, ridge), (2, ridge[::-1])):
        a, b = np.array(corners[first]), np.array(corners[first + 1])
        along = (b - a) / np.linalg.norm(b - a)
        outward = np.array([along[1], -along[0]])
        normal = np.array([*outward * slope, 1.0]) / math.hypot(slope, 1.0)
        v = float(shade(normal)) / BRIGHTEST
        edge = [(*(a + over * outward), low), (*(b + over * outward), low)]
        solids.append(polygon([*edge, *ends], [(u, 0.93 * v), (u, 0.93 * v), (u, v), (u, v)]))
        solids.append(polygon([*edge[::-1], *ends[::-1]], (u, 0.45 * v)))  # from below
    for begin, end, top in ((1, 2, ridge[0]), (3, 0, ridge[1])):
        a, b = np.array(corners[begin]), np.array(corners[end])
        along = (b - a) / np.linalg.norm(b - a)
        v = float(shade([along[1], -along[0], 0.0])) / BRIGHTEST
        solids.append(polygon([(*a, eaves_m), (*b, eaves_m), top], (wall_u, v)))
    return solids
