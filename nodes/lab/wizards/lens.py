"""Reads a lens from either of the two files that have one, and keeps what a new mounting pose does not change."""

from __future__ import annotations

from pathlib import Path

from calibration.measured import LensCalibration
from calibration.schema import CalibrationError, CameraCalibration, load_calibration

_FIELDS = ("date", "method", "width", "height", "fx", "fy", "cx", "cy", "distortion", "rms_px")


def load_lens(file: Path) -> LensCalibration:
    """Load a lens from a lens file or from a camera file.

    Raises:
        CalibrationError: The file is neither.
    """
    try:
        return load_calibration(LensCalibration, file)
    except CalibrationError as error:
        try:
            camera = load_calibration(CameraCalibration, file)
        except CalibrationError:
            raise error from None
    return LensCalibration(**{key: getattr(camera, key) for key in _FIELDS})


def with_kept(new: CameraCalibration, file: Path) -> CameraCalibration:
    """The calibration with ``latency_s`` and ``notes`` of the camera file that it replaces, if there is one.

    Raises:
        CalibrationError: The file is no camera file.
    """
    if not file.exists():
        return new
    old = load_calibration(CameraCalibration, file)
    return new.model_copy(update={"latency_s": old.latency_s, "notes": old.notes})
