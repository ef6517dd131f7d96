"""Prepares several logs for one training: the camera, the room, the labels of each, and the range of the steering."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from advnerf_core.driving.expert import Expert
from advnerf_core.policies.view import PolicyView
from calibration.schema import Calibration, CameraCalibration, load_calibration, parse_calibration
from nodes.lab.policy_data.frames import RecordedFrames, frames_of, view_for_camera, view_for_size, view_of
from nodes.lab.policy_data.logs import OpenLog

_LEAST_BOUND_RAD = 0.30
_BOUND_OVER_LABEL = 1.1  # the bound of a network is where its tanh never arrives

Model = TypeVar("Model", bound=Calibration)


def recorded_frames(opened: OpenLog, view: PolicyView, expert: Expert | None) -> RecordedFrames:
    """The usable frames of a log with its labels; images of another size than the view's are cropped at the same fraction."""
    return frames_of(opened.log, view_of(opened.log, view), expert, opened.labels)


def attached_calibration(
    model: type[Model], given: Path | None, logs: Sequence[OpenLog], name: str
) -> Model | None:
    """Load the given calibration file, or else the one attached to the first log that has it; None without any."""
    if given is not None:
        return load_calibration(model, given)
    for each in logs:
        if (content := each.log.attached().get(f"{name}.yaml")) is not None:
            return parse_calibration(model, content, f"{name}.yaml of {each.log.path}")
    return None


def policy_view(camera: Path | None, logs: Sequence[OpenLog]) -> PolicyView:
    """The policy's view: of the camera's calibration if there is one, or else for the size of the first log's images."""
    calibration: Any = attached_calibration(CameraCalibration, camera, logs, "camera")
    if calibration is not None:
        return view_for_camera(calibration.pinhole, calibration.distortion)
    height, width = logs[0].log.first_image().shape[:2]
    return view_for_size(width, height)


def crop_notes(logs: Iterable[OpenLog], view: PolicyView) -> list[str]:
    """A line for each log whose images have another size than the view's camera."""
    wanted = (view.camera.width, view.camera.height)
    found = [(each.name, each.log.first_image().shape) for each in logs]
    return [
        f"{name}: images of {width} x {height} are cropped at the same fraction as the policy's of {wanted[0]} x {wanted[1]}"
        f"{', and not undistorted' if any(view.distortion) else ''}"
        for name, (height, width, _) in found
        if (width, height) != wanted
    ]


def steering_bound_rad(logs: Iterable[OpenLog]) -> float:
    """Bound of a policy's steering that all recorded labels are within [rad]."""
    largest_rad = 0.0
    for each in logs:
        values = each.log.steering() if each.labels == "recorded" and each.log.unit else np.zeros(0)
        for value in (np.nanmin(values), np.nanmax(values)) if np.isfinite(values).any() else ():
            if each.log.unit is not None:
                largest_rad = max(largest_rad, abs(each.log.unit.wheel_rad(float(value), each.name)))
    return max(_LEAST_BOUND_RAD, _BOUND_OVER_LABEL * largest_rad)
