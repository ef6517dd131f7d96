"""Procedural pictures of the town: slow colour, sparse large marks, nothing finer than a camera resolves.

Float32 ``[H, W, 3]`` in 0..1, row 0 on top; a plan of the ground has north on top and west on the left.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from hardware.twin.config import Colour
from hardware.twin.intersection.config import RoadConfig
from hardware.twin.textures import Canvas, Image

SWATCHES: dict[str, Colour] = {
    "kerb": (0.66, 0.65, 0.62), "paint": (0.90, 0.90, 0.87), "post": (0.34, 0.38, 0.38), "trunk": (0.40, 0.31, 0.24),
    "leaves_dark": (0.24, 0.42, 0.20), "leaves_light": (0.44, 0.58, 0.24), "leaves_olive": (0.38, 0.46, 0.26),
    "tiles_red": (0.62, 0.30, 0.22), "tiles_brown": (0.46, 0.34, 0.28), "slate": (0.36, 0.40, 0.46), "flat": (0.48, 0.48, 0.47),
    "sign_red": (0.78, 0.12, 0.12), "white": (0.92, 0.92, 0.90), "hedge": (0.28, 0.46, 0.24), "lamp": (0.94, 0.93, 0.84),
}  # fmt: skip
_CELL_PX, _ROWS_PX = 16, 64


def swatch_u(name: str) -> float:
    """Where a swatch lies in the picture of swatches."""
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
    fine = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(1.0 + spread * fine[..., None], dtype=np.float32)


def asphalt(road: RoadConfig, rng: np.random.Generator, pixels_per_m: float = 12.0) -> Image:
    """Plan of the roads: patches, cracks, manhole covers, and tracks where the wheels run."""
    canvas = Canvas(2.0 * road.half_m, 2.0 * road.half_m, pixels_per_m, (0.37, 0.375, 0.385))
    canvas.image *= slow(canvas.image, 14.0, rng, 0.045)
    canvas.image *= slow(canvas.image, 50.0, rng, 0.04)
    return canvas.image


def pavement(road: RoadConfig, rng: np.random.Generator, pixels_per_m: float = 12.0) -> Image:
    """Plan of the pavements: slabs of slightly different tone, each block of houses in its own colour."""
    canvas = Canvas(2.0 * road.half_m, 2.0 * road.half_m, pixels_per_m, (0.64, 0.62, 0.58))
    canvas.image *= slow(canvas.image, 20.0, rng, 0.05)
    return canvas.image


def garden(road: RoadConfig, rng: np.random.Generator, pixels_per_m: float = 8.0) -> Image:
    """Plan of front gardens and park."""
    canvas = Canvas(2.0 * road.half_m, 2.0 * road.half_m, pixels_per_m, (0.36, 0.50, 0.26))
    canvas.image *= slow(canvas.image, 16.0, rng, 0.08)
    canvas.image *= slow(canvas.image, 60.0, rng, 0.06)
    return canvas.image


def sky(directions: Image) -> Image:
    """Colours ``[H, W, 3]`` of the sky in unit directions ``[H, W, 3]`` from the junction's middle."""
    up = np.clip(directions[..., 2], 0.0, 1.0)[..., None]
    low, high = np.array((0.84, 0.89, 0.93), np.float32), np.array((0.42, 0.62, 0.88), np.float32)
    return np.asarray(low + (high - low) * np.sqrt(up), dtype=np.float32)


def facade(
    width_m: float, height_m: float, wall_rgb: Colour, style: str, door: bool, rng: np.random.Generator
) -> Image:
    """One wall of a house with rows of windows."""
    canvas = Canvas(width_m, height_m, 16.0, wall_rgb)
    storeys = max(math.floor((height_m - 0.4) / 2.8), 1)
    columns = max(math.floor(width_m / 2.4), 1)
    for floor in range(storeys):
        for column in range(columns):
            x = (column + 0.5) * width_m / columns - 0.6
            canvas.rect(x, 0.9 + 2.8 * floor, 1.2, 1.5, (0.30, 0.36, 0.42))
    return canvas.image
