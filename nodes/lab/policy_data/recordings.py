"""Prepares several logs for one training: the camera, the room, the labels of each, and the range of the steering."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TypeVar

import numpy as np

from advnerf_core.driving.expert import Expert
from advnerf_core.policies.view import PolicyView
from calibration.schema import (
    Calibration,
    CameraCalibration,
    RoomCalibration,
    load_calibration,
    parse_calibration,
)
from nodes.lab.policy_camera import same_camera
from nodes.lab.policy_data.frames import RecordedFrames, frames_of, view_for_camera, view_for_size, view_of
from nodes.lab.policy_data.logs import OpenLog
from nodes.runtime.errors import ConfigError

_LEAST_BOUND_RAD = 0.30
_TOLERANCE_OF_COEFFICIENTS = 1e-3  # two calibrations of one lens
_BOUND_OVER_LABEL = 1.1  # the bound of a network is where its tanh never arrives

Model = TypeVar("Model", bound=Calibration)


def recorded_frames(opened: OpenLog, view: PolicyView, expert: Expert | None) -> RecordedFrames:
    """The usable frames of a log with its labels; images of another size than the view's are cropped at the same fraction."""
    return frames_of(opened.log, view_of(opened.log, view), expert, opened.labels)


def attached_calibrations(model: type[Model], logs: Iterable[OpenLog], name: str) -> dict[str, Model]:
    """The calibration files ``NAME.yaml`` that are attached to logs, by the names of the logs that have one.

    Raises:
        CalibrationError: One is wrong.
    """
    return {
        each.name: parse_calibration(model, content, f"{name}.yaml of {each.log.path}")
        for each in logs
        if (content := each.log.attached().get(f"{name}.yaml")) is not None
    }


def room_of(given: Path | None, logs: Sequence[OpenLog]) -> RoomCalibration | None:
    """The room whose path the expert follows: the given file's, or else that of the logs; None without any.

    Raises:
        ConfigError: Logs that the expert labels were recorded on different paths.
    """
    if given is not None:
        return load_calibration(RoomCalibration, given)
    rooms = attached_calibrations(RoomCalibration, (each for each in logs if each.labels == "expert"), "room")
    rooms = rooms or attached_calibrations(RoomCalibration, logs, "room")
    first = next(iter(rooms), None)
    for name, room in rooms.items():
        if first is not None and room.path != rooms[first].path:
            raise ConfigError(
                f"expected logs with one reference path, as the expert labels every pose for it, got room.yaml of {first} and another path in that of "
                f"{name}; train on each room's logs, give the path of all with --room, or use --labels recorded"
            )
    return None if first is None else rooms[first]


def policy_view(camera: Path | None, logs: Sequence[OpenLog]) -> PolicyView:
    """The policy's view: of the camera's calibration if there is one, or else for the size of the first log's images."""
    if camera is not None:
        calibration: CameraCalibration | None = load_calibration(CameraCalibration, camera)
    else:
        calibration = next(iter(attached_calibrations(CameraCalibration, logs, "camera").values()), None)
    if calibration is not None:
        return view_for_camera(calibration.pinhole, calibration.distortion)
    height, width = logs[0].log.first_image().shape[:2]
    return view_for_size(width, height)


def crop_notes(logs: Sequence[OpenLog], view: PolicyView) -> list[str]:
    """A line for each log whose images have another size than the view's camera, or are of another lens."""
    return [*_sizes(logs, view), *_lenses(logs, view)]


def _lenses(logs: Sequence[OpenLog], view: PolicyView) -> list[str]:
    wanted = view.camera
    return [
        f"{name}: its camera.yaml has another lens (fx {own.pinhole.fx:.4g}, distortion {list(own.distortion)}) than the policy's view "
        f"(fx {wanted.fx:.4g}, distortion {list(view.distortion)}); its images are taken as that view's"
        for name, own in attached_calibrations(CameraCalibration, logs, "camera").items()
        if (own.width, own.height) == (wanted.width, wanted.height)
        and not (same_camera(own.pinhole, wanted) and _same_distortion(own.distortion, view.distortion))
    ]


def _same_distortion(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two lists of OpenCV's coefficients mean one lens; those that are missing are 0."""
    padded = zip_longest(one, other, fillvalue=0.0)
    return all(math.isclose(a, b, abs_tol=_TOLERANCE_OF_COEFFICIENTS) for a, b in padded)


def _sizes(logs: Sequence[OpenLog], view: PolicyView) -> list[str]:
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
