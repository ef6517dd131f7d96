"""Colours of a print in a photograph: its picture seen straight on, and the light on it, from the white paper around the markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from advnerf_core.attack.printing.frame import CELLS, marker_cells
from advnerf_core.attack.printing.poster import MM_PER_M, Printable
from advnerf_core.geometry import Array
from advnerf_core.plain import PlainData
from advnerf_core.scene.colour import fit_colour_map
from advnerf_core.srgb import to_display
from calibration.degeneracy import DegenerateDataError
from calibration.print_markers import linear
from calibration.print_model import LaidPrint
from calibration.schema import Intrinsics

Rgb = NDArray[np.uint8]
_PAPER_CELLS, _PAPER = 1, 0.98  # of white around a marker; and the least share of it that counts as paper
_CURVED_FROM = 6  # markers: fewer give a slope of the light, and no curvature
_CLIPPED, _MOST_CLIPPED = 252, 0.2
_LEAST_WHITE, _LEAST_RATIO = 0.02, 2.0  # of linear light; of white to black
_MOST_UNEVEN = 0.5
_MOST_HIDDEN, _FAR = 0.5, 64.0
# Of a photograph: its own blur, from that of pixels and the interpolation between them to one that is out of focus, and one that is added.
_OWN_BLURS_PX, _BLUR_PX = (0.3, 4.5), 1.5
_CELLS, _FINER = 96, 4  # of the found print along a side, and samples along a side of a cell
_LONGEST_ROW = 2**14  # of OpenCV's remap


@dataclass(frozen=True, eq=False)
class Light:
    """The light on a print.

    Attributes:
        white: Coefficients ``[k, 3]`` of white paper's linear light over 1, y, z and, with ``k`` of 6, y^2, y z, z^2 [m].
        black: Linear light ``[3]`` of black ink, as a share of white paper's.
        uneven: Largest change of white over the markers, as a share of its mean.
        own_blur_px: Standard deviation of the photograph's blur, as the markers' cells show it [px].
    """

    white: Array
    black: Array
    uneven: float
    own_blur_px: float

    @property
    def blur_px(self) -> float:
        """Of the photograph's own blur and the added one together [px]."""
        return float(np.hypot(self.own_blur_px, _BLUR_PX))

    def white_at(self, points_m: Array) -> Array:
        """Linear light ``[..., 3]`` of white paper at points ``[..., 3]`` of the print."""
        return np.asarray(_terms(points_m, len(self.white)) @ self.white)


def sampled(rgb: Rgb, lens: Intrinsics, laid: LaidPrint, points_m: Array) -> Array:
    """Colours ``[..., 3]`` in 0..255 of a photograph ``[H, W, 3]`` at points ``[..., 3]`` of a print; NaN outside of it."""
    pixels = _pixels(laid.in_camera(points_m.reshape(-1, 3)), lens)
    where = (pixels - 0.5).astype(np.float32)
    found = np.empty((len(where), 3))
    image = rgb.astype(np.float32)
    for begin in range(0, len(where), _LONGEST_ROW):
        part = slice(begin, begin + _LONGEST_ROW)
        x, y = (np.ascontiguousarray(where[None, part, k]) for k in range(2))
        found[part] = cv2.remap(image, x, y, cv2.INTER_LINEAR)[0]
    found[~_inside(pixels, lens)] = np.nan
    return found.reshape(points_m.shape)


def in_picture(points_m: Array, lens: Intrinsics) -> bool:
    """Whether a photograph shows all points ``[N, 3]`` of the camera's frame, which lie before it."""
    return bool(_inside(_pixels(points_m, lens), lens).all())


def _pixels(points_m: Array, lens: Intrinsics) -> Array:
    matrix, zero = lens.pinhole.matrix, np.zeros(3)
    found = cv2.projectPoints(points_m, zero, zero, matrix, np.array(lens.distortion))[0]
    return np.asarray(found.reshape(-1, 2), np.float64)


def _inside(pixels: Array, lens: Intrinsics) -> NDArray[np.bool_]:
    return np.asarray(((pixels >= 0.5) & (pixels <= np.array([lens.width, lens.height]) - 0.5)).all(axis=1))


def light_on(rgb: Rgb, lens: Intrinsics, laid: LaidPrint, corners_m: Mapping[int, Array]) -> Light:
    """The light on a print, from its seen markers and the paper around them.

    At points of each marker, the light is that of white paper and of black ink, mixed as the markers' cells are in the photograph's pixels. So the
    light is right, too, where these are larger than a cell.

    Args:
        rgb: The photograph ``[H, W, 3]``.
        laid: The print as it lies before the camera.
        corners_m: Nominal corners ``[4, 3]`` of each seen marker by number [m].

    Raises:
        DegenerateDataError: The paper is overexposed, or too dark.
    """
    places, drawn, seen = [], [], []
    for number, corners in corners_m.items():
        points = _over_marker(corners)
        pixel = _pixel(lens, laid, points)
        white = np.pad(marker_cells(number) / 255.0, _PAPER_CELLS, constant_values=1.0)
        drawn.append((white.repeat(_FINER, 0).repeat(_FINER, 1), pixel))
        linear_seen = linear(sampled(rgb, lens, laid, points))
        seen.append(_blurred(linear_seen, _BLUR_PX * pixel).reshape(-1, 3))
        places.append(points.reshape(-1, 3))
    light, points = np.concatenate(seen), np.concatenate(places)
    terms = _terms(points, 6 if len(corners_m) >= _CURVED_FROM else 3)
    # Cells of a soft photograph are lit by their neighbours: with too small a blur, ink would be too bright in it.
    mixed = _mixed(drawn, terms, light)
    clipped = float((light[mixed.paper] >= linear(_CLIPPED)).any(axis=1).mean()) if mixed.paper.any() else 0.0
    if clipped > _MOST_CLIPPED:
        raise DegenerateDataError(
            f"expected white paper below {_CLIPPED} of 255, got more at {100 * clipped:.0f} % of it: shorten the exposure"
        )
    kept = np.isfinite(light).all(axis=1)
    fitted, dark = terms[kept] @ mixed.white, (terms[kept] @ mixed.ink).mean(axis=0)
    mean = fitted.mean(axis=0)
    if mean.min() < _LEAST_WHITE or (mean < _LEAST_RATIO * dark).any():
        raise DegenerateDataError(
            f"expected white paper that is bright against black ink, got {np.round(mean, 3).tolist()} and {np.round(dark, 3).tolist()} of full light: "
            "lengthen the exposure, or avoid reflections"
        )
    uneven = float((np.ptp(fitted, axis=0) / mean).max())
    return Light(mixed.white, np.clip(dark / mean, 0.0, 1.0), uneven, mixed.own_blur_px)


@dataclass(frozen=True, eq=False)
class _Mixed:
    """Paper and ink at the points of the markers ``[n]``, for a blur of the photograph: coefficients ``[k, 3]``, which points are paper, and the error."""

    own_blur_px: float
    white: Array
    ink: Array
    paper: NDArray[np.bool_]
    residual: float


def _mixed(drawn: Sequence[tuple[Array, float]], terms: Array, light: Array) -> _Mixed:
    """Paper, ink and the photograph's own blur that explain the light best."""
    kept = np.isfinite(light).all(axis=1)

    def fit(own_blur_px: float) -> _Mixed:
        blur_px = float(np.hypot(own_blur_px, _BLUR_PX))
        share = np.concatenate([_blurred(cells, blur_px * pixel).ravel() for cells, pixel in drawn])
        both = np.concatenate([terms * share[:, None], terms * (1.0 - share[:, None])], axis=1)[kept]
        coefficients = np.linalg.lstsq(both, light[kept], rcond=None)[0]
        residual = float(np.mean((both @ coefficients - light[kept]) ** 2))
        white, ink = np.split(coefficients, 2)
        return _Mixed(own_blur_px, white, ink, kept & (share > _PAPER), residual)

    found = minimize_scalar(lambda px: fit(px).residual, bounds=_OWN_BLURS_PX, options={"xatol": 0.01})
    return fit(float(found.x))


def _over_marker(corners: Array) -> Array:
    """Points ``[n, n, 3]`` of a marker and the paper around it, row 0 on top: `_FINER` along a side of a cell."""
    reach = 1.0 + 2.0 * _PAPER_CELLS / CELLS
    middle, count = corners.mean(axis=0), (CELLS + 2 * _PAPER_CELLS) * _FINER
    along = reach * ((np.arange(count) + 0.5) / count - 0.5)
    right, down = corners[1] - corners[0], corners[3] - corners[0]
    return np.asarray(middle + along[:, None, None] * down + along[None, :, None] * right)


def picture_points(picture_m: tuple[float, float], rows: int, columns: int) -> Array:
    """Centres ``[rows, columns, 3]`` of a grid's cells over a picture, row 0 on top [m]."""
    y = picture_m[0] * ((np.arange(columns) + 0.5) / columns - 0.5)
    z = picture_m[1] * (0.5 - (np.arange(rows) + 0.5) / rows)
    across, up = np.meshgrid(y, z)
    return np.stack([np.zeros_like(across), across, up], axis=-1)


def evenly_lit(seen: Array, light: Light, points_m: Array) -> Array:
    """sRGB colours ``[..., 3]`` in 0..255 as seen under the light of the print's middle, of seen ones ``[..., 3]``."""
    middle = light.white_at(np.zeros(3))
    return encoded(np.clip(linear(seen) * middle / np.maximum(light.white_at(points_m), 1e-6), 0.0, 1.0))


def encoded(light: Array) -> Array:
    """sRGB colours in 0..255 of linear light in 0..1."""
    return np.asarray(255.0 * to_display(light), np.float64)


def patch_colours(
    rgb: Rgb,
    lens: Intrinsics,
    laid: LaidPrint,
    picture_m: tuple[float, float],
    shape: tuple[int, int],
    corners_m: Mapping[int, Array],
) -> Array:
    """Mean colours ``[rows, columns, 3]`` in 0..1 of a chart's patches, as under the light of its middle.

    Args:
        rgb: The photograph ``[H, W, 3]``.
        laid: The chart as it lies before the camera.
        picture_m: Width and height of all patches [m].
        corners_m: Nominal corners ``[4, 3]`` of each seen marker by number [m].

    Raises:
        DegenerateDataError: The light is uneven, or a patch is not in the photograph.
    """
    light = light_on(rgb, lens, laid, corners_m)
    if light.uneven > _MOST_UNEVEN:
        raise DegenerateDataError(
            f"expected even light on the chart, got a change of {100 * light.uneven:.0f} %: turn it, or move the lamp"
        )
    centres = picture_points(picture_m, *shape)
    inside = picture_points((0.5 * picture_m[0] / shape[1], 0.5 * picture_m[1] / shape[0]), 9, 9).reshape(
        -1, 3
    )
    points = centres[:, :, None] + inside
    seen = sampled(rgb, lens, laid, points)
    if not np.isfinite(seen).all():
        raise DegenerateDataError("expected the whole chart in the photograph, got patches outside; go back")
    even = evenly_lit(seen, light, points)
    clipped = (seen >= _CLIPPED).any(axis=(-1, -2))
    even[clipped] = seen[clipped]
    return np.asarray(even.mean(axis=2) / 255.0, np.float64)


@dataclass(frozen=True, eq=False)
class ColourError(PlainData):
    """Difference of a print to its nominal texture, of sRGB colours in 0..255 in even white light.

    Attributes:
        rms: Root mean square, in light in which ink is black too.
        mean: Mean of each channel.
        far_share: Share of the picture that is off by more than a quarter of full scale, such as covered parts.
        seen_share: Share of the print that the photograph shows.
        uneven: Change of the light over the print, as a share of its mean.
    """

    rms: float
    mean: tuple[float, float, float]
    far_share: float
    seen_share: float
    uneven: float


@dataclass(frozen=True, eq=False)
class PrintColours:
    """A print with its border, as photographed. Parts that the photograph does not show have the nominal colours, changed like the others.

    Attributes:
        nominal: Printed colours ``[n, n, 3]`` uint8.
        seen: Colours in the camera ``[n, n, 3]`` uint8.
        unlit: Colours in even white light, in which paper is white ``[n, n, 3]`` uint8.
        error: Their difference to the nominal texture.
    """

    nominal: Rgb
    seen: Rgb
    unlit: Rgb
    error: ColourError


def print_colours(
    rgb: Rgb, lens: Intrinsics, laid: LaidPrint, sheet: Printable, corners_m: Mapping[int, Array]
) -> PrintColours:
    """The colours of a print in a photograph, and their difference to what was printed.

    Args:
        rgb: The photograph ``[H, W, 3]``.
        laid: The print as it lies before the camera.
        corners_m: Nominal corners ``[4, 3]`` of each seen marker by number [m].

    Raises:
        DegenerateDataError: The exposure does not show colours, or too much is outside the photograph.
    """
    light = light_on(rgb, lens, laid, corners_m)
    width_mm, height_mm = sheet.sheet_mm
    fine = _CELLS * _FINER
    points = picture_points((width_mm / MM_PER_M, height_mm / MM_PER_M), fine, fine)
    raw = sampled(rgb, lens, laid, points)
    printed = sheet.pixels((0.0, 0.0, width_mm, height_mm), (fine, fine))
    wanted, seen = _coarse(printed), _coarse(raw)
    hidden = np.asarray(~np.isfinite(seen).all(axis=-1), np.bool_)
    if hidden.mean() > _MOST_HIDDEN:
        raise DegenerateDataError(
            f"expected at least {100 * (1 - _MOST_HIDDEN):.0f} % of the print in the photograph, got {100 * (1 - hidden.mean()):.0f} %; go back"
        )
    pixel = _pixel(lens, laid, points)
    resolved = encoded(_blurred(linear(raw), _BLUR_PX * pixel))
    expected = encoded(_blurred(linear(printed), light.blur_px * pixel))
    inside = (np.abs(points[..., 1:]) < 0.5 * np.array(sheet.size_m)).all(axis=-1)
    inside &= np.isfinite(resolved).all(axis=-1)
    off = (_in_white(resolved, light, points, light.black) - expected)[inside]
    unlit = _coarse(_in_white(raw, light, points, 0.0))
    red, green, blue = off.mean(axis=0)
    error = ColourError(
        float(np.sqrt(np.mean(off**2))),
        (float(red), float(green), float(blue)),
        float((np.abs(off).max(axis=-1) > _FAR).mean()),
        float(1.0 - hidden.mean()),
        light.uneven,
    )
    return PrintColours(
        _whole(wanted),
        _whole(_completed(seen, wanted, hidden)),
        _whole(_completed(unlit, wanted, hidden)),
        error,
    )


def _pixel(lens: Intrinsics, laid: LaidPrint, points_m: Array) -> float:
    """A pixel of the photograph in points of a grid ``[n, n, 3]``, where the grid is finest in it."""
    pixels = _pixels(laid.in_camera(points_m.reshape(-1, 3)), lens)
    grid = pixels.reshape((*points_m.shape[:2], 2))
    least_px = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in range(2))
    return 1.0 / max(least_px, 1.0 / len(points_m))


def _blurred(values: Array, sigma: float) -> Array:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), float(sigma)), np.float64)


def _completed(found: Array, wanted: Array, hidden: NDArray[np.bool_]) -> Array:
    """Found colours ``[n, n, 3]``; where they are hidden, nominal ones as the map from nominal to found colours of the rest changes them."""
    if not hidden.any():
        return found
    colours = fit_colour_map(wanted[~hidden] / 255.0, found[~hidden] / 255.0)
    return np.where(hidden[..., None], 255.0 * colours.apply((wanted / 255.0).astype(np.float32)), found)


def _in_white(seen: Array, light: Light, points_m: Array, black: Array | float) -> Array:
    """sRGB colours ``[..., 3]`` in 0..255 in light in which paper is white, and what is as dark as ``black`` is black."""
    share = linear(seen) / np.maximum(light.white_at(points_m), 1e-6)
    return encoded(np.clip((share - black) / (1.0 - black), 0.0, 1.0))


def _whole(colours: Array) -> Rgb:
    return np.round(np.clip(colours, 0.0, 255.0)).astype(np.uint8)


def _coarse(fine: ArrayLike) -> Array:
    parts = np.asarray(fine, np.float64).reshape(_CELLS, _FINER, _CELLS, _FINER, 3)
    return np.asarray(parts.mean(axis=(1, 3)))


def _terms(points_m: Array, count: int) -> Array:
    y, z = points_m[..., 1], points_m[..., 2]
    terms = [np.ones_like(y), y, z, y * y, y * z, z * z][:count]
    return np.stack(terms, axis=-1)
