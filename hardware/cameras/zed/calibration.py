"""Factory calibration of a ZED, and the rectification of its left eye to an ideal pinhole camera.

The file ``SN<serial>.conf`` is downloaded from ``calib.stereolabs.com/?SN=<serial>`` or is in ``/usr/local/zed/settings``. It is an
INI file with one section for each eye and resolution. Its principal points have pixel centres at integers, as in OpenCV.
"""

from __future__ import annotations

import configparser
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Pinhole
from hardware.errors import HardwareError

# Width and height of one eye [px], and the name of the mode in the file.
EYE_SIZES = {"2K": (2208, 1242), "HD1080": (1920, 1080), "HD720": (1280, 720), "VGA": (672, 376)}
_SECTION_SUFFIX = {"2K": "2K", "HD1080": "FHD", "HD720": "HD", "VGA": "VGA"}


class ZedCalibrationError(HardwareError, ValueError):
    """The factory calibration file is missing or wrong."""


@dataclass(frozen=True)
class EyeCalibration:
    """One eye of a ZED in one mode.

    Attributes:
        pinhole: Intrinsics before rectification, pixel centres at +0.5.
        distortion: OpenCV's k1, k2, p1, p2, k3.
    """

    pinhole: Pinhole
    distortion: tuple[float, float, float, float, float]


def load_factory_calibration(path: Path | str, mode: str = "VGA") -> EyeCalibration:
    """Read the left eye's intrinsics for one mode from ``SN<serial>.conf``.

    Args:
        mode: One of `EYE_SIZES`.

    Raises:
        ZedCalibrationError: The file is missing or invalid, or has values that do not fit this mode.
    """
    path = Path(path)
    sections = _sections(path)
    name = f"left_cam_{_SECTION_SUFFIX[mode]}".lower()
    if name not in sections:
        raise ZedCalibrationError(
            f"expected a section [{name.upper()}] in {path}, found {', '.join(sorted(sections)) or 'none'}; download the file"
            " again from https://calib.stereolabs.com"
        )
    values = sections[name]
    width, height = EYE_SIZES[mode]
    try:
        fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
        # Older files have no tangential terms and no k3.
        k1, k2, p1, p2, k3 = (float(values.get(key, "0")) for key in ("k1", "k2", "p1", "p2", "k3"))
    except KeyError as error:
        raise ZedCalibrationError(
            f"{path}: [{name.upper()}] has no {error.args[0]}; download the file again from https://calib.stereolabs.com"
        ) from None
    except ValueError as error:
        raise ZedCalibrationError(f"{path}: [{name.upper()}]: {error}") from None
    numbers = np.array([fx, fy, cx, cy, k1, k2, p1, p2, k3])
    plausible = (
        0.2 * width < fx < 3.0 * width
        and 0.25 * width < cx < 0.75 * width
        and 0.25 * height < cy < 0.75 * height
    )
    if not (np.isfinite(numbers).all() and plausible and 0.9 < fy / fx < 1.1):
        raise ZedCalibrationError(
            f"{path}: [{name.upper()}] has fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}, which do not fit {width} x {height}; download the file again from https://calib.stereolabs.com"
        )
    return EyeCalibration(Pinhole(width, height, fx, fy, cx + 0.5, cy + 0.5), (k1, k2, p1, p2, k3))


def _sections(path: Path) -> dict[str, dict[str, str]]:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ZedCalibrationError(
            f"expected a ZED calibration file at {path}, found none; download it from https://calib.stereolabs.com/?SN=<serial number on the camera>"
        ) from None
    except (OSError, UnicodeDecodeError, configparser.Error) as error:
        reason = " ".join(str(error).split())
        raise ZedCalibrationError(
            f"expected a ZED calibration file at {path}, cannot read it: {reason}"
        ) from None
    # The C++ readers ignore case in section names; keys are lowered by the parser.
    return {name.lower(): dict(parser[name]) for name in parser.sections()}


class Rectifier:
    """Removes the distortion from images of one size and scales them down.

    The field of view of the ideal camera lies within the real one's, so there are no black corners.

    Args:
        size: Width and height of the result [px].

    Attributes:
        pinhole: The ideal camera, at the size of the result.
    """

    def __init__(self, calibration: EyeCalibration, size: tuple[int, int]) -> None:
        source = calibration.pinhole
        full = (source.width, source.height)
        if not (0 < size[0] <= full[0] and 0 < size[1] <= full[1]):
            raise ValueError(f"expected a size of at most {full[0]} x {full[1]}, got {size[0]} x {size[1]}")
        K = source.matrix
        K[:2, 2] -= 0.5
        D = np.array(calibration.distortion)
        ideal, _ = cv2.getOptimalNewCameraMatrix(K, D, full, 0.0, full)
        self._maps = cv2.initUndistortRectifyMap(K, D, None, ideal, full, cv2.CV_16SC2)
        self._size = size
        whole = Pinhole(*full, ideal[0, 0], ideal[1, 1], ideal[0, 2] + 0.5, ideal[1, 2] + 0.5)
        self.pinhole = whole.resized(*size)

    def __call__(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify an image ``[H, W, 3]`` to ``[h, w, 3]``."""
        straight = cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR)
        if straight.shape[1::-1] != self._size:
            straight = cv2.resize(straight, self._size, interpolation=cv2.INTER_AREA)
        straight.flags.writeable = False
        return np.asarray(straight, dtype=np.uint8)
