"""Procedural plans of the ground, and the swatches: slow colour, sparse large marks, nothing finer than a camera resolves.

Float32 ``[H, W, 3]`` in 0..1, row 0 on top; a plan of the ground has north on top and west on the left.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np

from advnerf_core.geometry import Array
from hardware.worlds.junction.config import RoadConfig
from hardware.worlds.junction.solids import SUN
from hardware.worlds.junction.town import HOUSES, TREES, WALLS, House
from hardware.worlds.lab.config import Colour
from hardware.worlds.lab.textures import Canvas, Image

SWATCHES: dict[str, Colour] = {
    "kerb": (0.66, 0.65, 0.62), "paint": (0.90, 0.90, 0.87), "post": (0.34, 0.38, 0.38), "trunk": (0.40, 0.31, 0.24),
    "leaves_dark": (0.24, 0.42, 0.20), "leaves_light": (0.44, 0.58, 0.24), "leaves_olive": (0.38, 0.46, 0.26),
    "tiles_red": (0.62, 0.30, 0.22), "tiles_brown": (0.46, 0.34, 0.28), "slate": (0.36, 0.40, 0.46), "flat": (0.52, 0.51, 0.49),
    "sign_red": (0.78, 0.12, 0.12), "white": (0.92, 0.92, 0.90), "hedge": (0.27, 0.42, 0.22), "lamp": (0.94, 0.93, 0.84),
    "blue": (0.16, 0.34, 0.62), "yellow": (0.90, 0.72, 0.16), "wood": (0.56, 0.40, 0.26), **WALLS,
}  # fmt: skip
_CELL_PX, _ROWS_PX = 16, 64


def swatch_u(name: str) -> float:
    """Picture coordinate u of a swatch."""
    return (list(SWATCHES).index(name) + 0.5) / len(SWATCHES)


def swatches(brightest: float) -> Image:
    """One column per colour, from black below to ``brightest`` times the colour on top."""
    v = np.linspace(brightest, 0.0, _ROWS_PX, dtype=np.float32)[:, None, None]
    columns = np.repeat(np.array(list(SWATCHES.values()), np.float32), _CELL_PX, axis=0)
    return np.asarray(np.clip(columns[None] * v, 0.0, 1.0), dtype=np.float32)


def slow(like: Image, waves: float, rng: np.random.Generator, spread: float) -> Image:
    """A smooth random field ``[H, W, 1]`` around 1 for a picture, with about ``waves`` bumps along its longer side."""
    height, width = like.shape[:2]
    scale = waves / max(height, width)
    coarse = rng.standard_normal((max(round(height * scale), 2) + 2, max(round(width * scale), 2) + 2))
    fine = cv2.resize(
        np.clip(coarse, -2.0, 2.0).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    return np.asarray(1.0 + spread * fine[..., None], dtype=np.float32)


class MapCanvas(Canvas):
    """A canvas addressed in world coordinates [m], the junction's middle in its middle."""

    def __init__(self, half_m: float, pixels_per_m: float, rgb: Colour) -> None:
        super().__init__(2.0 * half_m, 2.0 * half_m, pixels_per_m, rgb)
        self._half_m = half_m

    def polygon(self, points_m: list[tuple[float, float]], rgb: Colour) -> None:
        """Fill a polygon of world points (x, y) [m], edges smoothed."""
        super().polygon([(x + self._half_m, y + self._half_m) for x, y in points_m], rgb)

    def line(self, points_m: list[tuple[float, float]], width_m: float, rgb: Colour) -> None:
        """Draw a line of a width [m] along world points."""
        points = np.asarray(points_m)
        for a, b in itertools.pairwise(points):
            along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
            aside = 0.5 * width_m * np.array([-along[1], along[0]])
            self.polygon([tuple(p) for p in (a - aside, b - aside, b + aside, a + aside)], rgb)


def asphalt(road: RoadConfig, rng: np.random.Generator, pixels_per_m: float = 12.0) -> Image:
    """Plan of the roads: newer and older stretches, repaired patches, a few cracks, and manhole covers."""
    plan = MapCanvas(road.half_m, pixels_per_m, (0.385, 0.385, 0.39))
    width, half = road.lane_width_m, road.half_m
    # The side road was laid later; two stretches of the main road are older.
    plan.rect(-width - 9.0, -half, 2.0 * width + 18.0, half - width, (0.345, 0.35, 0.365))
    plan.rect(13.0, -width, half, 2.0 * width, (0.415, 0.405, 0.395))
    plan.rect(-half, -width, half - 31.0, 2.0 * width, (0.41, 0.405, 0.40))
    plan.image[:] = cv2.GaussianBlur(plan.image, (0, 0), 0.12 * pixels_per_m)
    for _ in range(34):
        _patch(plan, *_on_a_road(road, rng), rng)
    for _ in range(22):
        _crack(plan, *_on_a_road(road, rng), rng)
    for x, y in (
        (-17.0, -1.2),
        (-4.2, 1.4),
        (9.5, -2.4),
        (19.0, 1.9),
        (1.1, -16.5),
        (-2.3, -26.0),
        (-31.0, 1.0),
    ):
        plan.disc(x, y, 0.42, (0.27, 0.27, 0.28))
        plan.disc(x, y, 0.33, (0.33, 0.32, 0.32))
    plan.image *= slow(plan.image, 16.0, rng, 0.035)
    plan.image *= slow(plan.image, 60.0, rng, 0.03)
    return plan.image


def _on_a_road(road: RoadConfig, rng: np.random.Generator) -> tuple[float, float]:
    """A random point on the asphalt, more often near the junction."""
    along = float(rng.triangular(0.0, 6.0, 45.0))
    across = float(rng.uniform(-road.lane_width_m, road.lane_width_m)) * 0.9
    arm = int(rng.integers(3))
    return (across, -along) if arm == 0 else ((along if arm == 1 else -along), across)


def _patch(plan: MapCanvas, x: float, y: float, rng: np.random.Generator) -> None:
    length, width, angle = (
        rng.uniform(0.8, 3.5),
        rng.uniform(0.5, 1.4),
        rng.choice([0.0, 0.5 * math.pi]) + rng.normal(0.0, 0.06),
    )
    tone = rng.choice([0.82, 0.88, 1.12]) * 0.38
    c, s = math.cos(angle), math.sin(angle)
    ends = [(0.5 * a * length, 0.5 * b * width) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    plan.polygon([(x + c * u - s * v, y + s * u + c * v) for u, v in ends], (tone, tone, 1.02 * tone))


def _crack(plan: MapCanvas, x: float, y: float, rng: np.random.Generator) -> None:
    heading, points = rng.uniform(0.0, 2.0 * math.pi), [(x, y)]
    for _ in range(int(rng.integers(3, 7))):
        heading += rng.normal(0.0, 0.5)
        x, y = x + 0.6 * math.cos(heading), y + 0.6 * math.sin(heading)
        points.append((x, y))
    plan.line(points, 0.07, (0.31, 0.31, 0.315))


def pavement(road: RoadConfig, rng: np.random.Generator, pixels_per_m: float = 12.0) -> Image:
    """Plan of the pavements: slabs of slightly different tone, each block of houses in its own colour, and shadows."""
    half, width = road.half_m, road.lane_width_m
    plan = MapCanvas(half, pixels_per_m, (0.64, 0.59, 0.55))
    plan.rect(-half, -half, half, half, (0.61, 0.61, 0.60))
    plan.rect(0.0, -half, half, half, (0.66, 0.63, 0.55))
    count = round(2.0 * half)
    tones = 1.0 + np.clip(0.035 * rng.standard_normal((count, count, 1)), -0.08, 0.08)
    size = plan.image.shape[:2]
    slabs = cv2.resize(tones.astype(np.float32), size[::-1], interpolation=cv2.INTER_NEAREST)
    plan.image *= np.asarray(slabs[..., None], dtype=np.float32)
    reach, ends = road.pavement_width_m + 0.1, width + road.corner_radius_m
    for x, y, wide, deep in (  # tactile slabs where the zebras begin
        (-width - reach, -ends - 3.2, reach, 2.4),
        (width, -ends - 3.2, reach, 2.4),
        (-ends - 3.2, width, 2.4, reach),
        (-ends - 3.2, -width - reach, 2.4, reach),
    ):
        plan.rect(x, y, wide, deep, (0.74, 0.66, 0.42))
    plan.image *= slow(plan.image, 24.0, rng, 0.04)
    return _shadowed(plan.image, road, pixels_per_m)


def garden(road: RoadConfig, rng: np.random.Generator, pixels_per_m: float = 8.0) -> Image:
    """Plan of front gardens and park: grass, paths to the doors, beds, forecourts of the shops, and shadows."""
    plan = MapCanvas(road.half_m, pixels_per_m, (0.38, 0.50, 0.27))
    plan.image *= slow(plan.image, 18.0, rng, 0.07)
    plan.image *= slow(plan.image, 70.0, rng, 0.05)
    for house in HOUSES:
        _front_garden(plan, house, rng)
    path = (0.70, 0.62, 0.48)
    plan.line([(6.0, -8.0), (9.5, -11.8), (14.0, -12.6), (21.6, -12.4)], 1.5, path)  # through the park
    plan.line([(6.0, -18.0), (10.5, -17.4), (13.2, -12.7)], 1.3, path)
    for x, y, radius, rgb in (
        (9.0, -8.2, 0.9, (0.72, 0.34, 0.36)),
        (17.0, -18.0, 1.5, (0.74, 0.60, 0.28)),
        (8.2, -22.2, 0.8, (0.58, 0.40, 0.58)),
    ):
        plan.disc(x, y, radius, rgb)
    return _shadowed(plan.image, road, pixels_per_m)


def _front_garden(plan: MapCanvas, house: House, rng: np.random.Generator) -> None:
    """Garden between a house's front and the pavement."""
    (x0, x1), (y0, y1) = house.x, house.y
    middle, deep = (0.5 * (x0 + x1), 0.5 * (y0 + y1)), 4.0
    stone = (0.62, 0.58, 0.52)
    if house.front == "south":
        box, path = (x0, y0 - deep, x1 - x0, deep), (middle[0] - 0.7, y0 - deep, 1.4, deep)
    elif house.front == "north":
        box, path = (x0, y1, x1 - x0, deep), (middle[0] - 0.7, y1, 1.4, deep)
    elif house.front == "east":
        box, path = (x1, y0, deep, y1 - y0), (x1, middle[1] - 0.7, deep, 1.4)
    else:
        box, path = (x0 - deep, y0, deep, y1 - y0), (x0 - deep, middle[1] - 0.7, deep, 1.4)
    if house.style in ("shop", "hall"):
        plan.rect(box[0] - 0.8, box[1] - 0.8, box[2] + 1.6, box[3] + 1.6, stone)
        return
    plan.rect(*path, stone)
    for sign in (-1.0, 1.0):  # a bed on each side of the door
        aside = sign * float(rng.uniform(2.0, 3.0))
        rgb = [(0.66, 0.36, 0.40), (0.72, 0.62, 0.30), (0.46, 0.36, 0.26)][int(rng.integers(3))]
        x, y = path[0] + 0.5 * path[2], path[1] + 0.5 * path[3]
        along_x = house.front in ("north", "south")
        near = {"south": (0.0, 1.5), "north": (0.0, -1.5), "east": (-1.5, 0.0), "west": (1.5, 0.0)}[
            house.front
        ]
        plan.disc(
            x + near[0] + (aside if along_x else 0.0), y + near[1] + (0.0 if along_x else aside), 0.6, rgb
        )


def _shadowed(image: Image, road: RoadConfig, pixels_per_m: float) -> Image:
    """Soft shadows of houses and trees on raised ground."""
    shadow = MapCanvas(road.half_m, 0.5 * pixels_per_m, (0.0, 0.0, 0.0))
    away: Array = -SUN[:2] / SUN[2]
    for house in HOUSES:
        (x0, x1), (y0, y1) = house.x, house.y
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        both = np.concatenate([corners, corners + house.eaves_m * away]).astype(np.float32)
        hull = cv2.convexHull(both)[:, 0]
        shadow.polygon([(float(x), float(y)) for x, y in hull], (1.0, 1.0, 1.0))
    for tree in TREES:
        x, y = np.array([tree.x_m, tree.y_m]) + (tree.height_m - 1.1 * tree.radius_m) * away
        shadow.disc(float(x), float(y), 0.95 * tree.radius_m, (1.0, 1.0, 1.0))
    soft = cv2.GaussianBlur(shadow.image, (0, 0), 0.2 * pixels_per_m)
    fine = cv2.resize(soft, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(image * (1.0 - np.array((0.36, 0.34, 0.28), np.float32) * fine), dtype=np.float32)
