"""Photographs of a print by ray tracing: each ray of a distorted lens meets the sheet's plane, or a bent sheet; then light, blur, noise."""

from __future__ import annotations

import datetime
from functools import lru_cache

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from advnerf_core.attack.printing.poster import Printable
from advnerf_core.geometry import invert_transform, make_transform, rotation_x, rotation_y, rotation_z
from calibration.measured import LensCalibration

DISTORTION = (-0.12, 0.05, 0.0006, -0.0004, 0.0)
# A face (x to the viewer, y right, z up) straight before a camera (x right, y down, z forward).
FACING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])


def lens(width=1280, height=960, focal=1000.0, distortion=DISTORTION) -> LensCalibration:
    return LensCalibration(
        date=datetime.date(2026, 1, 1), method="by construction", width=width, height=height, fx=focal, fy=focal,
        cx=0.5 * width + 4.3, cy=0.5 * height - 6.1, distortion=distortion, rms_px=None,
    )  # fmt: skip


def before_camera(distance_m, turn_deg=0.0, tilt_deg=0.0, roll_deg=0.0, right_m=0.0, down_m=0.0):
    """``T_camera_from_face`` of a face at a distance, turned about its vertical, tilted and rolled."""
    turn, tilt, roll = np.radians([turn_deg, tilt_deg, roll_deg])
    R = FACING @ rotation_z(turn) @ rotation_y(tilt) @ rotation_x(roll)
    return make_transform(R, [right_m, down_m, distance_m])


@lru_cache(maxsize=2)
def _rays(width, height, focal, cx, cy, distortion, supersampling):
    """Directions through the lens's undistortion, smooth between every eighth pixel: splines of x and y over rows and columns."""
    columns, rows = np.arange(-8.0, width + 9.0, 8.0), np.arange(-8.0, height + 9.0, 8.0)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    flat = cv2.undistortPointsIter(pixels, matrix, np.array(distortion), None, None, criteria)
    grid = flat.reshape(len(rows), len(columns), 2)
    down, right = ((np.arange(n * supersampling) + 0.5) / supersampling for n in (height, width))
    x, y = (RectBivariateSpline(rows, columns, grid[..., k])(down, right) for k in range(2))
    for directions in (x, y):
        directions.setflags(write=False)
    return x, y


def rays(lens, supersampling):
    """Directions through the lens with unit depth: x and y, each ``[H s, W s]``."""
    return _rays(lens.width, lens.height, lens.fx, lens.cx, lens.cy, lens.distortion, supersampling)


def photograph(
    sheets, lens, *, light=(1.0, 1.0, 1.0), slope=0.0, blur_px=0.7, noise=2.0, covered=None, bend_m=0.0,
    seed=0, supersampling=2, dpi=200.0, wall=0.35, black=0.03, response=None,
):  # fmt: skip
    """A photograph ``[H, W, 3]`` of sheets on a wall.

    Args:
        sheets: Pairs of a printable, or a picture in linear light with its size, and its ``T_camera_from_face``; the first is the nearest.
        light: Of each channel; the white of paper where there is no slope.
        slope: Change of the light from the left of the picture to its right, as a share.
        covered: Share of the photograph's width that something grey covers, from the left.
        bend_m: Sagitta of sheets bent about their vertical middle.
        black: Reflectance of ink.
        response: Seen colours of linear light; sRGB if None.
    """
    directions = rays(lens, supersampling)
    found = np.full((*directions[0].shape, 3), wall)
    for sheet, T in reversed(sheets):
        _draw_over(found, directions, sheet, T, bend_m, dpi, black)
    across = np.linspace(-0.5, 0.5, found.shape[1])[None, :, None]
    found *= np.array(light) * (1.0 + slope * across)
    if covered is not None:
        found[:, : round(covered * found.shape[1])] = 0.12
    size = (lens.width, lens.height)
    if blur_px:
        found = cv2.GaussianBlur(found, (0, 0), blur_px * supersampling)
    found = cv2.resize(found, size, interpolation=cv2.INTER_AREA)
    seen = encoded(np.clip(found, 0.0, 1.0)) if response is None else response(found)
    seen = 255.0 * seen + np.random.default_rng(seed).normal(0.0, noise, found.shape)
    return np.clip(np.round(seen), 0, 255).astype(np.uint8)


def encoded(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def decoded(seen):
    return np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4)


def _draw_over(behind, directions, sheet, T, bend_m, dpi, black):
    picture, (width_m, height_m) = _picture(sheet, dpi)
    part = _where(directions, T, width_m, height_m, bend_m)
    right, down = (each[part] for each in directions)
    if not right.size:
        return
    T_face_from_camera = invert_transform(T)
    origin = T_face_from_camera[:3, 3]
    slopes = [right * a + down * b + c for a, b, c in T_face_from_camera[:3, :3]]
    depth = np.zeros(right.shape)
    for _ in range(12 if bend_m else 1):  # fixed point of the bent sheet: x = bend (1 - (2 y / width)^2)
        y = origin[1] + depth * slopes[1]
        x = _bent(y, width_m, bend_m)
        with np.errstate(divide="ignore"):
            depth = (x - origin[0]) / slopes[0]
    y, z = (origin[k] + depth * slopes[k] for k in (1, 2))
    columns = (y / width_m + 0.5) * picture.shape[1] - 0.5
    rows = (0.5 - z / height_m) * picture.shape[0] - 0.5
    inside = (np.abs(y) < 0.5 * width_m) & (np.abs(z) < 0.5 * height_m) & (depth > 0.0)
    seen = cv2.remap(
        picture,
        columns.astype(np.float32),
        rows.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    np.copyto(behind[part], black + (1.0 - black) * seen, where=inside[..., None])


def _bent(y_m, width_m, bend_m):
    return bend_m * (1.0 - np.clip(2.0 * y_m / width_m, -1.0, 1.0) ** 2)


def _where(directions, T, width_m, height_m, bend_m):
    """Slices of rows and columns that surely contain a sheet: in the rest of a photograph nothing has to be computed."""
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 33) * width_m, np.linspace(-0.5, 0.5, 33) * height_m)
    places = np.stack([_bent(y, width_m, bend_m), y, z], axis=-1) @ T[:3, :3].T + T[:3, 3]
    if places[..., 2].min() <= 0.0:
        return slice(None), slice(None)
    ends = []
    # Directions grow along a row and a column, as far as they may bend.
    for axis, along in enumerate(directions):
        seen = places[..., axis] / places[..., 2]
        room = 0.02 * np.ptp(seen)
        lines = ((along > seen.min() - room) & (along < seen.max() + room)).any(axis=axis)
        found = np.flatnonzero(lines)
        ends.append(slice(found[0], found[-1] + 1) if len(found) else slice(0, 0))
    columns, rows = ends
    return rows, columns


def _picture(sheet, dpi):
    if not isinstance(sheet, Printable):
        return sheet
    width_mm, height_mm = sheet.sheet_mm
    size = (round(width_mm * dpi / 25.4), round(height_mm * dpi / 25.4))
    return _pixels(sheet, size), (width_mm / 1000.0, height_mm / 1000.0)


@lru_cache(maxsize=4)
def _pixels(sheet, size):
    """Reflectance ``[h, w, 3]``, before it is mixed with that of ink."""
    return decoded(np.arange(256) / 255.0).astype(np.float32)[sheet.pixels((0.0, 0.0, *sheet.sheet_mm), size)]


def scaled(sheet, across=1.0, up=1.0, dpi=150.0):
    """A sheet that was printed at another size: its picture in linear light, and its true width and height [m]."""
    picture, (width_m, height_m) = _picture(sheet, dpi)
    return picture, (across * width_m, up * height_m)
