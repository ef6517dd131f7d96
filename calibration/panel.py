"""Converts an attack of known size to pixels of a monitor. The face is shown in true size in the panel's centre square."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import AttackFile
from calibration.placement import require_same_corners
from calibration.schema import CalibrationError, TargetCalibration

Rgb = NDArray[np.uint8]
_SIZE_TOLERANCE = 0.02  # of EDID against ruler; a wrong unit or another monitor is further off
_FIT_TOLERANCE = 0.005  # of the square's side: a rounding in the measured corners
_CENTRE_TOLERANCE_M = 0.01


@dataclass(frozen=True)
class MonitorPanel:
    """A monitor's panel.

    Attributes:
        size_px: Width and height [px].
        size_m: Width and height of the picture [m].
    """

    size_px: tuple[int, int]
    size_m: tuple[float, float]

    @property
    def square_m(self) -> float:
        """Side of the largest centred square [m]."""
        return min(self.size_m)

    def pixels_of(self, size_m: tuple[float, float]) -> tuple[int, int]:
        """Width and height [px] of a face [m], rounded to whole pixels; never more than the panel has."""
        width, height = (
            min(round(face / panel * pixels), pixels)
            for face, panel, pixels in zip(size_m, self.size_m, self.size_px, strict=True)
        )
        return width, height

    def picture(self, face: Rgb, size_m: tuple[float, float]) -> Rgb:
        """A face ``[h, w, 3]`` in its true size in the middle of a black screen, nearest neighbour, ``[H, W, 3]``."""
        width, height = self.pixels_of(size_m)
        screen = np.zeros((self.size_px[1], self.size_px[0], 3), np.uint8)
        left, top = (self.size_px[0] - width) // 2, (self.size_px[1] - height) // 2
        rows, columns = _nearest(height, face.shape[0]), _nearest(width, face.shape[1])
        screen[top : top + height, left : left + width] = face[np.ix_(rows, columns)]
        return screen


def _nearest(pixels: int, cells: int) -> NDArray[np.intp]:
    """Index of the cell that each pixel's centre lies in."""
    return ((np.arange(pixels) + 0.5) * cells / pixels).astype(np.intp)


def target_size(target: TargetCalibration) -> tuple[float, float]:
    """Width and height of a target [m]."""
    corners = target.corners
    return float(np.linalg.norm(corners[1] - corners[0])), float(np.linalg.norm(corners[3] - corners[0]))


def make_panel(
    size_px: tuple[int, int], target: TargetCalibration, edid_mm: tuple[float, float] | None = None
) -> MonitorPanel:
    """The panel of a monitor; an error if its EDID and the calibration disagree on its size, as one belongs to another monitor.

    Args:
        size_px: Native width and height [px].
        target: Measured corners of the whole panel.
        edid_mm: Size in the monitor's EDID [mm]; None uses the measured corners only.
    """
    measured = target_size(target)
    if edid_mm is None:
        return MonitorPanel(size_px, measured)
    said = (edid_mm[0] / 1000.0, edid_mm[1] / 1000.0)
    if any(abs(m / s - 1.0) > _SIZE_TOLERANCE for m, s in zip(measured, said, strict=True)):
        raise CalibrationError(
            f"the monitor reports a picture of {said[0]:.3f} x {said[1]:.3f} m, but the corners of target {target.subject} give "
            f"{measured[0]:.3f} x {measured[1]:.3f} m; measure the whole panel (advnerf scene room target), or set size_mm to override"
        )
    return MonitorPanel(size_px, said)


def require_fits(attack: AttackFile, panel: MonitorPanel, target: TargetCalibration) -> None:
    """Raise for an attack that this panel cannot show exactly: another carrier, turned, too large, or off the centre."""
    face = attack.face
    if face is None or face.subject != target.subject:
        what = f"for {face.subject}" if face is not None else "without a face"
        raise CalibrationError(
            f"attack {attack.attack_id} is {what}, but this is {target.subject}: search one for it"
        )
    require_same_corners(attack, target)
    if max(face.size_m) > panel.square_m * (1.0 + _FIT_TOLERANCE):
        raise CalibrationError(
            f"attack {attack.attack_id} is {face.size_m[0]:.3f} x {face.size_m[1]:.3f} m, more than the {panel.square_m:.3f} m of "
            f"the centre square of {target.subject}: search one with size_m: {panel.square_m:.3f}"
        )
    off_m = float(np.linalg.norm(face.corners_in_subject.mean(axis=0) - target.corners.mean(axis=0)))
    if off_m > _CENTRE_TOLERANCE_M:
        raise CalibrationError(
            f"attack {attack.attack_id} has its face {100 * off_m:.1f} cm from the middle of {target.subject}; only the centre square "
            "of a monitor is used: search one whose corners are those of the centre square"
        )
