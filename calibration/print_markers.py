"""The markers around a print in a photograph: corners from straight lines through the edges, and how sharp these edges are.

Blur rounds a corner inwards, but does not move a straight edge. So each side's edge is located in profiles across it, in linear
light, a line is fitted in undistorted coordinates, and corners are where lines meet.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.aruco import marker_dictionary
from advnerf_core.attack.printing.frame import CELLS, DICTIONARY
from advnerf_core.geometry import Array
from advnerf_core.srgb import to_linear
from advnerf_core.undistortion import ray_slopes
from calibration.degeneracy import DegenerateDataError
from calibration.schema import Intrinsics

Rgb = NDArray[np.uint8]
LEAST_MARKERS = 3
_ENDS = 0.12  # of a side, left out at both ends
_REACH_CELLS = 0.85  # of a profile to each side of the edge: the black edge is one cell wide
_PROFILE = 35  # samples of a profile
_LEAST_CELL_PX = 1.6
_MOST_BLUR_CELLS = 0.5
_LEAST_CONTRAST = 0.03  # of linear light
_LEAST_SAMPLES, _MOST_SAMPLES = 5, 60
_QUARTILES = 1.349  # between the quartiles of a normal distribution, in its standard deviations
_SHARP_PX = 3.0
_LARGE_PX = 4_000_000
_DIRECTIONS, _MOST_PIXELS = 36, 500_000


class SeenTwiceError(DegenerateDataError):
    """A photograph shows a marker of the print twice."""


def linear(rgb: ArrayLike) -> Array:
    """Linear light in 0..1 of sRGB colours in 0..255."""
    return to_linear(np.asarray(rgb, np.float64) / 255.0)


def find_markers(
    rgb: Rgb, lens: Intrinsics, wanted: Mapping[int, Array], what: str = "the print"
) -> dict[int, Array]:
    """Corners ``[4, 2]`` of a photograph's wanted markers by number, undistorted, pixel centres at +0.5 [px]; possibly none.

    Args:
        rgb: The photograph ``[H, W, 3]``, as the lens draws it.
        wanted: Markers by number.
        what: Name of the sheet, for messages.

    Raises:
        SeenTwiceError: A marker is seen twice.
        DegenerateDataError: The edges of most are too blurred or too small.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    # Small markers are found in an enlarged picture.
    times = 2 if grey.size < _LARGE_PX else 1
    enlarged = cv2.resize(grey, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
    detector = cv2.aruco.ArucoDetector(marker_dictionary(DICTIONARY), _small())
    corners, numbers, _ = detector.detectMarkers(enlarged)
    found = [] if numbers is None else [int(number) for number in numbers.ravel()]
    light = linear(grey).astype(np.float32)
    located, poor = {}, []
    for pixels, number in zip(corners, found, strict=True):
        if number not in wanted:
            continue
        if found.count(number) > 1:
            raise SeenTwiceError(
                f"expected one print, got marker {number} {found.count(number)} times in a picture; cover the other one"
            )
        rough = (pixels.reshape(4, 2).astype(np.float64) + 0.5) / times - 0.5
        marker = _located(light, lens, rough)
        if isinstance(marker, str):
            poor.append(marker)
        else:
            located[number] = marker
    if poor and len(located) < LEAST_MARKERS:
        raise DegenerateDataError(
            f"expected at least {LEAST_MARKERS} sharp markers of {what}, got {len(located)}, and {len(poor)} of which {poor[0]}"
        )
    return located


def _small() -> cv2.aruco.DetectorParameters:
    """Parameters for small markers: the middle of each cell is read, and wrong cells are corrected as far as the dictionary allows.

    A wrong detection is left to the geometry of the print to refuse.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    parameters.errorCorrectionRate = 1.0
    return parameters


def why_none(rgb: Rgb) -> str:
    """A reason for which a photograph shows no markers."""
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(np.float32)
    low, high = np.percentile(grey, [1, 99])
    if high - low < 20.0:
        return "the picture is nearly of one grey: check the exposure"
    # A camera that moves leaves the edges along its way sharp, so the least sharp direction decides.
    across, down = (
        cv2.Sobel(grey, -1, *order).ravel()[:: 1 + grey.size // _MOST_PIXELS] for order in ((1, 0), (0, 1))
    )
    turns = np.linspace(0.0, np.pi, _DIRECTIONS, endpoint=False)
    steepest = min(np.percentile(np.abs(np.cos(t) * across + np.sin(t) * down), 99.9) for t in turns) / 8.0
    blur_px = (high - low) / max(float(steepest), 1e-6) / np.sqrt(2.0 * np.pi)
    if blur_px > _SHARP_PX:
        return f"no edge is sharper than about {blur_px:.0f} px in some direction: it is out of focus, or the camera moved"
    return "the print is not in view, is too small, is covered, or belongs to another .print.json"


def _located(light: NDArray[np.float32], lens: Intrinsics, rough: Array) -> Array | str:
    """Corners ``[4, 2]`` of a marker, or why they cannot be found."""
    cell_px = float(np.linalg.norm(rough - np.roll(rough, -1, axis=0), axis=1).min()) / CELLS
    if cell_px < _LEAST_CELL_PX:
        return (
            f"a cell is {cell_px:.1f} px wide, below {_LEAST_CELL_PX:g}: go nearer, or print larger markers"
        )
    lines, blurs = [], []
    for start, end in zip(rough, np.roll(rough, -1, axis=0), strict=True):
        points, blur_px = _edge(light, start, end)
        if len(points) < _LEAST_SAMPLES:
            return "an edge has too little contrast: it is in shadow, overexposed or covered"
        blurs.append(blur_px)
        ideal = undistorted(points + 0.5, lens)
        if not np.isfinite(ideal).all():
            return "the lens's coefficients say nothing of where it is: hold it nearer to the middle, or calibrate the lens with the board there"
        lines.append(_line(ideal))
    blur_px = float(np.median(blurs))
    if blur_px > _MOST_BLUR_CELLS * cell_px:
        return f"edges are blurred by {blur_px:.1f} px at cells of {cell_px:.1f} px: it is out of focus, or the camera moved"
    corners = [_meet(one, other) for one, other in zip(np.roll(lines, 1, axis=0), lines, strict=True)]
    return np.array(corners)


def undistorted(pixels: Array, lens: Intrinsics) -> Array:
    """Pixels ``[N, 2]`` of a lens as its pinhole would draw them; NaN where the lens draws nothing."""
    matrix = lens.pinhole.matrix
    return ray_slopes(pixels, matrix, lens.distortion) @ matrix[:2, :2].T + matrix[:2, 2]


def _edge(light: NDArray[np.float32], start: Array, end: Array) -> tuple[Array, float]:
    """Points ``[n, 2]`` (centres at 0) where profiles across a side are half dark, and the median blur [px].

    Corners are clockwise in the picture, so the outside is to the left of each side.
    """
    length_px = float(np.linalg.norm(end - start))
    along = (end - start) / length_px
    outside = np.array([along[1], -along[0]])
    count = int(np.clip(length_px, 2 * _LEAST_SAMPLES, _MOST_SAMPLES))
    feet = start + np.linspace(_ENDS, 1.0 - _ENDS, count)[:, None] * (end - start)
    cell_px = length_px / CELLS
    offsets = np.asarray(np.linspace(-_REACH_CELLS, _REACH_CELLS, _PROFILE) * cell_px, np.float64)
    where = (feet[:, None] + offsets[None, :, None] * outside).astype(np.float32)
    profiles = cv2.remap(
        light, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    # The middle of the black edge, and white where blur does not reach: beyond them begins what a marker shows.
    black, white = np.abs(offsets + 0.5 * cell_px) <= 0.1 * cell_px, offsets >= 0.6 * cell_px
    dark, bright = profiles[:, black].mean(axis=1), profiles[:, white].mean(axis=1)
    usable = bright - dark > _LEAST_CONTRAST
    shares = ((profiles - dark[:, None])[usable] / (bright - dark)[usable, None]).astype(np.float64)
    quarter, half, most = (_crossings(shares, offsets, level) for level in (0.25, 0.5, 0.75))
    kept = np.isfinite(half)
    blur_px = float(np.nanmedian((most - quarter)[kept])) / _QUARTILES if kept.any() else np.inf
    return (feet[usable] + half[:, None] * outside)[kept], blur_px


def _crossings(shares: Array, offsets: Array, level: float) -> Array:
    """Offset ``[n]`` nearest to 0 at which each profile ``[n, k]`` rises through a level; NaN where none does."""
    below, above = shares[:, :-1] < level, shares[:, 1:] >= level
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (level - shares[:, :-1]) / (shares[:, 1:] - shares[:, :-1])
    places = offsets[:-1] + share * (offsets[1] - offsets[0])
    places = np.where(below & above, places, np.inf)
    nearest = np.take_along_axis(places, np.abs(places).argmin(axis=1)[:, None], axis=1)[:, 0]
    return np.asarray(np.where(np.isfinite(nearest), nearest, np.nan), np.float64)


def _line(points: Array) -> Array:
    """The line ``a x + b y + c = 0``, ``[3]`` with ``a^2 + b^2 = 1``, through points ``[n, 2]``, without the outliers among them."""
    kept = points
    for _ in range(3):
        middle = kept.mean(axis=0)
        normal = np.linalg.svd(kept - middle)[2][1]
        off = np.abs((points - middle) @ normal)
        kept = points[off <= max(3.0 * float(np.median(off)), 0.05)]
    return np.array([*normal, -normal @ middle])


def _meet(one: Array, other: Array) -> Array:
    x, y, w = np.cross(one, other)
    return np.array([x / w, y / w])
