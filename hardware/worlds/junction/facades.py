"""Walls of houses with windows and doors, painted in metres from the lower left corner as seen from outside."""

from __future__ import annotations

import math

import numpy as np

from hardware.worlds.junction.pictures import slow
from hardware.worlds.junction.town import Style
from hardware.worlds.lab.config import Colour
from hardware.worlds.lab.textures import Canvas, Image

STOREY_M = 2.9
_PIXELS_PER_M = 16.0
_FRAME: Colour = (0.90, 0.89, 0.85)
_DOORS: tuple[Colour, ...] = ((0.40, 0.20, 0.16), (0.16, 0.34, 0.30), (0.18, 0.26, 0.46), (0.44, 0.32, 0.20))
_ACCENTS: tuple[Colour, ...] = (
    (0.72, 0.22, 0.18),
    (0.14, 0.42, 0.40),
    (0.84, 0.58, 0.16),
    (0.24, 0.32, 0.56),
)


def facade(
    width_m: float, height_m: float, wall_rgb: Colour, style: Style, front: bool, rng: np.random.Generator
) -> Image:
    """One wall of a house.

    Args:
        wall_rgb: Colour of the wall, 0..1.
        front: Whether this wall has the door.

    Returns:
        Picture ``[H, W, 3]``, row 0 on top, unlit.
    """
    canvas = Canvas(width_m, height_m, _PIXELS_PER_M, wall_rgb)
    canvas.image *= slow(canvas.image, 5.0, rng, 0.025)
    accent = _ACCENTS[int(rng.integers(len(_ACCENTS)))]
    dark = _scaled(wall_rgb, 0.72)
    canvas.rect(0.0, 0.0, width_m, 0.5, dark)
    canvas.rect(0.0, height_m - 0.3, width_m, 0.3, _scaled(wall_rgb, 1.12))
    if style == "hall":
        _hall(canvas, width_m, front, dark)
        return canvas.image
    storeys, columns = max(math.floor(height_m / STOREY_M), 1), max(math.floor(width_m / 2.3), 1)
    ground = 1 if style == "shop" else 0
    for storey in range(ground, storeys):
        if storey > 0:
            canvas.rect(
                0.0,
                STOREY_M * storey + 0.1,
                width_m,
                0.14,
                _scaled(wall_rgb, 1.14 if style != "house" else 0.9),
            )
        for column in range(columns):
            middle = (column + 0.5) * width_m / columns
            if front and storey == 0 and column == columns // 2:
                _door(canvas, middle, _DOORS[int(rng.integers(len(_DOORS)))])
                continue
            balcony = style == "flats" and front and storey > 0 and (column + storey) % 2 == 0
            _window(canvas, middle, STOREY_M * storey + 0.95, style, accent, balcony, rng)
    if style == "shop":
        _shop(canvas, width_m, front, accent)
    return canvas.image


def _scaled(rgb: Colour, factor: float) -> Colour:
    return min(rgb[0] * factor, 1.0), min(rgb[1] * factor, 1.0), min(rgb[2] * factor, 1.0)


def _glass(
    canvas: Canvas, x: float, y: float, width: float, height: float, rng: np.random.Generator | None = None
) -> None:
    """A dark pane, paler on top where it mirrors the sky; behind some hangs a curtain."""
    canvas.gradient(x, y, width, height, (0.20, 0.25, 0.31), (0.44, 0.54, 0.64))
    if rng is not None and rng.random() < 0.35:
        canvas.rect(x, y + 0.45 * height, width, 0.55 * height, (0.78, 0.74, 0.66))


def _window(
    canvas: Canvas, x: float, y: float, style: Style, accent: Colour, balcony: bool, rng: np.random.Generator
) -> None:
    wide, high = (1.1, 1.35) if style == "house" else (1.25, 1.5)
    left = x - 0.5 * wide
    if balcony:
        y, high = y - 0.75, high + 0.75
    canvas.rect(left - 0.12, y - 0.12, wide + 0.24, high + 0.24, _FRAME)
    _glass(canvas, left, y, wide, high, rng)
    canvas.rect(x - 0.05, y, 0.1, high, _FRAME)
    if style == "house":
        for side in (left - 0.52, left + wide + 0.14):  # shutters
            canvas.rect(side, y - 0.08, 0.38, high + 0.16, accent)
    else:
        canvas.rect(left - 0.2, y - 0.24, wide + 0.4, 0.12, _scaled(_FRAME, 0.86))
    if balcony:
        canvas.rect(left - 0.4, y - 0.1, wide + 0.8, 0.9, (0.46, 0.49, 0.52))
        canvas.rect(left - 0.4, y + 0.7, wide + 0.8, 0.1, (0.30, 0.32, 0.34))


def _door(canvas: Canvas, x: float, rgb: Colour) -> None:
    canvas.rect(x - 0.75, 0.0, 1.5, 2.5, _FRAME)
    canvas.rect(x - 0.58, 0.0, 1.16, 2.3, rgb)
    _glass(canvas, x - 0.36, 1.35, 0.72, 0.7)
    canvas.rect(x - 0.9, 0.0, 1.8, 0.18, (0.58, 0.57, 0.55))


def _shop(canvas: Canvas, width: float, front: bool, accent: Colour) -> None:
    """A shop on the ground floor: panes between pillars, a striped awning, and a name board."""
    canvas.rect(0.0, 0.0, width, STOREY_M, (0.30, 0.29, 0.29))
    panes = max(round(width / 2.6), 2)
    for pane in range(panes):
        x = 0.25 + pane * (width - 0.25) / panes
        wide = (width - 0.25) / panes - 0.25
        door = front and pane == panes // 2
        _glass(canvas, x, 0.15 if door else 0.6, wide, 2.0 if door else 1.55)
        goods = _ACCENTS[pane % len(_ACCENTS)]
        canvas.rect(x + 0.15 * wide, 0.62, (0.1 if door else 0.7) * wide, 0.35, _scaled(goods, 0.8))
    stripes = max(round(width / 0.8), 4)
    for stripe in range(stripes):
        rgb = accent if stripe % 2 == 0 else (0.93, 0.91, 0.86)
        canvas.rect(stripe * width / stripes, 2.2, width / stripes, 0.55, rgb)
    canvas.rect(0.0, 2.75, width, 0.5, _scaled(accent, 0.7))
    for letter in range(5):
        canvas.rect(0.5 * width - 1.6 + 0.66 * letter, 2.86, 0.42, 0.28, (0.94, 0.90, 0.78))


def _hall(canvas: Canvas, width: float, front: bool, dark: Colour) -> None:
    """A public hall: tall arched windows between pilasters, and a gate."""
    bays = max(round(width / 3.2), 1)
    for bay in range(bays):
        x = (bay + 0.5) * width / bays
        canvas.rect(x - 0.5 * width / bays - 0.2, 0.0, 0.4, 7.4, _scaled(dark, 1.25))
        gate = front and bay == bays // 2
        low = 0.0 if gate else 1.4
        canvas.rect(x - 0.85, low, 1.7, 4.4 - low, _FRAME)
        canvas.disc(x, 4.4, 0.85, _FRAME)
        canvas.disc(x, 4.4, 0.65, (0.40, 0.48, 0.56))
        if gate:
            canvas.rect(x - 0.65, 0.0, 1.3, 3.4, _DOORS[3])
        else:
            _glass(canvas, x - 0.65, low + 0.2, 1.3, 4.2 - low)
