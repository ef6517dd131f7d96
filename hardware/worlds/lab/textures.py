"""Procedural pictures of the room's surfaces: mostly smooth colour, sparse large marks, light baked in.

All images are float32 ``[H, W, 3]`` in 0..1 while they are made and uint8 when they leave. Row 0 is the top of a wall and
the far side (largest y) of the floor; column 0 is a viewer's left, for the floor the smallest x.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from hardware.worlds.lab.config import Colour

Image = NDArray[np.float32]
Rgb = NDArray[np.uint8]


def to_uint8(image: Image) -> Rgb:
    """Quantise an image in 0..1."""
    return np.asarray(np.rint(np.clip(image, 0.0, 1.0) * 255.0), dtype=np.uint8)


def with_light(image: Image, light: Array) -> Image:
    """Multiply an image by a coarse map of light ``[h, w]``, interpolated smoothly."""
    height, width = image.shape[:2]
    fine = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(image * fine[..., None], dtype=np.float32)


def smooth_waves(like: Image, size_m: tuple[float, float], rng: np.random.Generator, count: int) -> Image:
    """A sum of ``count`` random plane waves of 1.2 to 6 m, about -1..1, ``[H, W, 1]``: variation without noise."""
    height, width = like.shape[:2]
    coarse = (height // 8, width // 8)  # the shortest wave is metres long, an eighth of the pixels carries it
    y, x = np.meshgrid(
        np.linspace(0.0, size_m[0], coarse[0]), np.linspace(0.0, size_m[1], coarse[1]), indexing="ij"
    )
    total = np.zeros(coarse)
    for _ in range(count):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        rate = 2.0 * np.pi / rng.uniform(1.2, 6.0)
        total += np.cos(rate * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    waves = (total / np.sqrt(2.0 * count)).astype(np.float32)
    fine = cv2.resize(waves, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine[..., None], dtype=np.float32)


class Canvas:
    """An image addressed in metres from the lower left corner, as one thinks of a wall or a floor plan."""

    def __init__(self, width_m: float, height_m: float, pixels_per_m: float, rgb: Colour) -> None:
        self._scale, self._height_m = pixels_per_m, height_m
        shape = (round(height_m * pixels_per_m), round(width_m * pixels_per_m), 3)
        self.image: Image = np.full(shape, rgb, dtype=np.float32)

    def polygon(self, points_m: list[tuple[float, float]], rgb: Colour) -> None:
        """Fill a polygon of points (right, up) [m], edges smoothed."""
        shift = 4  # fixed-point bits: sub-pixel corners
        pixels = [
            (
                round((x * self._scale - 0.5) * 2**shift),
                round(((self._height_m - y) * self._scale - 0.5) * 2**shift),
            )
            for x, y in points_m
        ]
        _fill(self.image, np.array(pixels, dtype=np.int32), rgb, shift)

    def rect(self, x: float, y: float, width: float, height: float, rgb: Colour) -> None:
        """Fill a rectangle given by its lower left corner and size [m]."""
        self.polygon([(x, y), (x + width, y), (x + width, y + height), (x, y + height)], rgb)

    def disc(self, x: float, y: float, radius: float, rgb: Colour) -> None:
        """Fill a disc [m]."""
        angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        self.polygon([(x + radius * float(np.cos(a)), y + radius * float(np.sin(a))) for a in angles], rgb)

    def gradient(self, x: float, y: float, width: float, height: float, bottom: Colour, top: Colour) -> None:
        """Fill a rectangle [m] with a vertical gradient."""
        left, right = round(x * self._scale), round((x + width) * self._scale)
        low, high = (
            round((self._height_m - y) * self._scale),
            round((self._height_m - y - height) * self._scale),
        )
        blend = np.linspace(1.0, 0.0, low - high, dtype=np.float32)[:, None, None]
        self.image[high:low, left:right] = blend * np.array(top, np.float32) + (1.0 - blend) * np.array(
            bottom, np.float32
        )


def _fill(image: Image, points: NDArray[np.int32], rgb: Colour, shift: int) -> None:
    mask = np.zeros(image.shape[:2], dtype=np.uint8)
    cv2.fillPoly(mask, [points], 255, lineType=cv2.LINE_AA, shift=shift)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    alpha = (mask[window] / np.float32(255.0))[..., None]
    image[window] = (1.0 - alpha) * image[window] + alpha * np.array(rgb, np.float32)


def floor_image(side_m: float, rng: np.random.Generator, pixels_per_m: float = 128.0) -> Image:
    """Floor plan seen from above: tiles of slightly different tone, two rugs, and sparse muted marks."""
    canvas = Canvas(side_m, side_m, pixels_per_m, (0.62, 0.57, 0.51))
    count = round(side_m / 0.8)
    tile = side_m / count
    for i in range(count):
        for j in range(count):
            tone = 1.0 + float(rng.uniform(-0.05, 0.05))
            warm = float(rng.uniform(-0.012, 0.012))
            rgb = (0.62 * tone + warm, 0.57 * tone, 0.51 * tone - warm)
            canvas.rect(i * tile, j * tile, tile, tile, rgb)
    _rugs(canvas, side_m)
    _marks(canvas, side_m, rng)
    canvas.image *= 1.0 + 0.06 * smooth_waves(canvas.image, (side_m, side_m), rng, 10)
    return canvas.image


def _rugs(canvas: Canvas, side_m: float) -> None:
    middle = 0.5 * side_m
    for radius, rgb in ((1.15, (0.34, 0.40, 0.52)), (1.0, (0.58, 0.50, 0.44)), (0.86, (0.40, 0.45, 0.55))):
        canvas.disc(middle, middle, radius, rgb)
    # A runner in front of the sofa, and a doormat.
    canvas.rect(side_m - 1.35, middle + 0.2, 0.42, 1.7, (0.60, 0.34, 0.28))
    canvas.rect(side_m - 1.27, middle + 0.3, 0.26, 1.5, (0.76, 0.62, 0.44))
    canvas.rect(side_m - 1.45, 0.12, 0.95, 0.5, (0.34, 0.33, 0.34))
    canvas.rect(0.3, middle + 0.9, 0.6, 1.6, (0.36, 0.46, 0.42))


def _marks(canvas: Canvas, side_m: float, rng: np.random.Generator) -> None:
    palette: list[Colour] = [(0.42, 0.35, 0.31), (0.74, 0.70, 0.62), (0.55, 0.40, 0.34), (0.45, 0.50, 0.56)]
    for _ in range(26):
        x, y = rng.uniform(0.5, side_m - 0.5, 2)
        size, angle = rng.uniform(0.05, 0.13), rng.uniform(0.0, np.pi)
        rgb = palette[int(rng.integers(len(palette)))]
        if rng.random() < 0.5:
            canvas.disc(float(x), float(y), float(size), rgb)
            continue
        corners = [(1.6, 0.4), (-1.6, 0.4), (-1.6, -0.4), (1.6, -0.4)]
        c, s = np.cos(angle), np.sin(angle)
        canvas.polygon(
            [(float(x + size * (c * u - s * v)), float(y + size * (s * u + c * v))) for u, v in corners], rgb
        )


def wall_images(
    side_m: float, height_m: float, rng: np.random.Generator, pixels_per_m: float = 128.0
) -> dict[str, Image]:
    """The four walls as seen from inside, by the compass side they stand on (north is +y, east is +x)."""
    painters = {"south": _south, "east": _east, "north": _north, "west": _west}
    colours: dict[str, tuple[Colour, Colour]] = {
        "south": ((0.80, 0.72, 0.55), (0.86, 0.81, 0.68)),
        "east": ((0.50, 0.62, 0.72), (0.66, 0.74, 0.80)),
        "north": ((0.78, 0.56, 0.46), (0.84, 0.70, 0.62)),
        "west": ((0.50, 0.60, 0.48), (0.68, 0.74, 0.66)),
    }
    images = {}
    for name, paint in painters.items():
        canvas = Canvas(side_m, height_m, pixels_per_m, (0.0, 0.0, 0.0))
        canvas.gradient(0.0, 0.0, side_m, height_m, *colours[name])
        canvas.image *= 1.0 + 0.07 * smooth_waves(canvas.image, (height_m, side_m), rng, 8)
        paint(canvas, side_m)
        canvas.rect(0.0, 0.0, side_m, 0.09, (0.34, 0.29, 0.26))  # skirting board
        images[name] = canvas.image
    return images


def _frame(
    canvas: Canvas, x: float, y: float, width: float, height: float, frame: Colour, inside: Colour
) -> None:
    canvas.rect(x - 0.05, y - 0.05, width + 0.1, height + 0.1, frame)
    canvas.rect(x, y, width, height, inside)


def _window(canvas: Canvas, x: float, y: float, width: float, height: float) -> None:
    canvas.rect(x - 0.08, y - 0.08, width + 0.16, height + 0.16, (0.90, 0.89, 0.86))
    canvas.gradient(x, y, width, height, (0.86, 0.90, 0.92), (0.52, 0.70, 0.90))
    canvas.polygon(
        [
            (x, y),
            (x + width, y),
            (x + width, y + 0.22),
            (x + 0.6 * width, y + 0.38),
            (x + 0.3 * width, y + 0.20),
            (x, y + 0.30),
        ],
        (0.42, 0.54, 0.40),
    )
    canvas.rect(x + 0.5 * width - 0.03, y, 0.06, height, (0.90, 0.89, 0.86))


def _south(canvas: Canvas, side: float) -> None:
    # Seen from inside, left is east: the door is in the south-east corner's neighbourhood.
    canvas.rect(0.55, 0.0, 0.98, 2.08, (0.40, 0.28, 0.20))
    canvas.rect(0.62, 0.0, 0.84, 2.02, (0.56, 0.40, 0.28))
    canvas.rect(0.76, 0.20, 0.56, 0.70, (0.49, 0.34, 0.24))
    canvas.rect(0.76, 1.06, 0.56, 0.78, (0.49, 0.34, 0.24))
    canvas.disc(1.36, 1.0, 0.04, (0.85, 0.78, 0.50))
    _frame(canvas, 3.2, 1.15, 1.1, 0.75, (0.20, 0.20, 0.22), (0.88, 0.84, 0.74))
    canvas.disc(3.55, 1.52, 0.22, (0.78, 0.30, 0.22))
    canvas.polygon([(3.75, 1.22), (4.2, 1.22), (3.98, 1.75)], (0.20, 0.40, 0.56))
    canvas.disc(5.35, 1.95, 0.2, (0.92, 0.91, 0.88))
    canvas.disc(5.35, 1.95, 0.16, (0.30, 0.34, 0.40))


def _east(canvas: Canvas, side: float) -> None:
    # Left is north. Behind the board (y = -1.75) the wall stays plain.
    _window(canvas, 1.9, 1.0, 1.8, 1.1)
    _frame(canvas, 4.35, 1.2, 0.6, 0.8, (0.86, 0.84, 0.80), (0.24, 0.30, 0.46))
    canvas.polygon([(4.35, 1.2), (4.95, 1.2), (4.95, 1.55), (4.6, 1.35), (4.35, 1.6)], (0.86, 0.62, 0.30))
    canvas.disc(4.75, 1.78, 0.09, (0.94, 0.90, 0.78))
    _frame(canvas, 6.75, 1.25, 0.5, 0.7, (0.32, 0.22, 0.18), (0.78, 0.80, 0.72))
    canvas.polygon([(6.8, 1.3), (7.2, 1.3), (7.0, 1.8)], (0.46, 0.24, 0.40))


def _north(canvas: Canvas, side: float) -> None:
    # Left is west.
    _window(canvas, 3.85, 1.05, 1.5, 1.05)
    _frame(canvas, 1.95, 1.35, 0.9, 0.62, (0.24, 0.22, 0.22), (0.40, 0.56, 0.58))
    canvas.polygon([(1.95, 1.35), (2.85, 1.35), (2.85, 1.52), (2.4, 1.72), (1.95, 1.5)], (0.24, 0.36, 0.34))
    _frame(canvas, 6.1, 1.1, 0.55, 0.8, (0.90, 0.88, 0.84), (0.82, 0.76, 0.40))
    canvas.rect(6.18, 1.2, 0.39, 0.16, (0.30, 0.30, 0.36))
    canvas.disc(6.37, 1.6, 0.16, (0.66, 0.26, 0.30))


def _west(canvas: Canvas, side: float) -> None:
    # Left is south.
    _frame(canvas, 0.9, 1.1, 1.6, 0.95, (0.62, 0.63, 0.65), (0.92, 0.93, 0.93))
    canvas.polygon([(1.1, 1.3), (1.5, 1.3), (1.5, 1.36), (1.1, 1.36)], (0.76, 0.22, 0.22))
    canvas.polygon([(1.65, 1.4), (2.25, 1.75), (2.22, 1.8), (1.62, 1.45)], (0.16, 0.34, 0.62))
    canvas.disc(1.3, 1.72, 0.13, (0.25, 0.52, 0.36))
    _frame(canvas, 3.55, 1.25, 0.62, 0.62, (0.20, 0.18, 0.18), (0.72, 0.42, 0.28))
    canvas.rect(3.7, 1.4, 0.32, 0.32, (0.90, 0.80, 0.56))
    canvas.rect(4.35, 1.35, 0.42, 0.12, WALL_SHELF)
    _frame(canvas, 6.85, 1.2, 0.5, 0.85, (0.30, 0.32, 0.30), (0.86, 0.86, 0.80))
    canvas.polygon([(6.9, 1.25), (7.3, 1.25), (7.3, 1.6), (6.9, 1.9)], (0.36, 0.30, 0.52))


WALL_SHELF: Colour = (0.42, 0.32, 0.24)


def ceiling_image(side_m: float, rng: np.random.Generator, pixels_per_m: float = 32.0) -> Image:
    """White ceiling with four bright lamps where ``lighting.lamp_samples`` puts them."""
    canvas = Canvas(side_m, side_m, pixels_per_m, (0.80, 0.79, 0.77))
    canvas.image *= 1.0 + 0.03 * smooth_waves(canvas.image, (side_m, side_m), rng, 6)
    middle, spread = 0.5 * side_m, 0.225 * side_m
    for a in (-1, 1):
        for b in (-1, 1):
            canvas.rect(middle + a * spread - 0.6, middle + b * spread - 0.35, 1.2, 0.7, (1.0, 0.99, 0.95))
    return canvas.image


def screen_image(width: int, height: int) -> Image:
    """The monitor's idle picture: a dark desktop with a soft glow."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    glow = np.exp(-1.5 * ((x - 0.2) ** 2 + (y - 0.3) ** 2)).astype(np.float32)[..., None]
    return np.array((0.06, 0.08, 0.12), np.float32) + glow * np.array((0.10, 0.16, 0.24), np.float32)


def fit(rgb: Rgb, width: int, height: int) -> Rgb:
    """Resample a picture ``[h, w, 3]`` uint8 to a texture's size: by area when it shrinks, else linearly."""
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(f"expected an RGB picture [h, w, 3] of uint8, got {rgb.shape} of {rgb.dtype}")
    shrinks = rgb.shape[0] > height or rgb.shape[1] > width
    resized = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.ascontiguousarray(resized)
