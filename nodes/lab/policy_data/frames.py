"""Takes training frames from the log of a drive.

Only images captured while the car was armed are used. The label is either the expert's steering at the measured pose (so every log
with poses is a DAgger round, no matter which driver recorded it), or the recorded command. Disturbances that the expert added to its
steering are in neither: they are not in the expert's control law, and ``recorded`` skips such frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from advnerf_core.data.image_files import Rgb
from advnerf_core.data.logs.choice import LogError
from advnerf_core.data.logs.drive_log import (
    FASTEST_HZ,
    NO_COMMAND,
    DriveLog,
    Labels,
    LogFrame,
    too_few_frames,
)
from advnerf_core.driving.expert import Expert
from advnerf_core.geometry import Pinhole
from advnerf_core.learning.frames import Frames, FrameSet
from advnerf_core.policies.view import PolicyView
from nodes.runtime.clock import NS_PER_S

LEAST_FRAMES = 4
# Logs are short: of every five blocks of frames, one is kept for validation.
HOLDOUT_EVERY = 5
_GIVE_UP_M = 0.7
_NEW_DRIVE_S = 1.0  # the live node forgets after such a pause, too


@dataclass(frozen=True, eq=False)
class RecordedFrames:
    """Frames with their stamps.

    Attributes:
        frames: Images, states (NaN if not measured) and labels.
        stamps_ns: Capture stamps ``[N]`` [ns]; row numbers for a log without stamps.
        recorded_rad: Sent steering ``[N]`` [rad]; NaN without a command.
        name: Origin of the frames.
        counts: Number of skipped images, by reason.
    """

    frames: Frames
    stamps_ns: np.ndarray[Any, np.dtype[np.int64]]
    recorded_rad: np.ndarray[Any, np.dtype[np.float64]]
    name: str
    counts: dict[str, int]

    @property
    def has_times(self) -> bool:
        """Whether the stamps are times: row numbers would be nanoseconds."""
        steps_ns = np.abs(np.diff(self.stamps_ns))
        return bool(len(steps_ns)) and float(np.median(steps_ns)) * FASTEST_HZ >= NS_PER_S

    def drive_starts(self) -> list[int]:
        """Numbers of the frames before which the log pauses or goes back, with the first: there a policy has no memory."""
        if not self.has_times:
            return [0]
        steps_s = np.abs(np.diff(self.stamps_ns)) / NS_PER_S
        return [0, *map(int, np.flatnonzero(steps_s > _NEW_DRIVE_S) + 1)]


def frames_of(log: DriveLog, view: PolicyView, expert: Expert | None, labels: Labels) -> RecordedFrames:
    """Take the usable frames of a log.

    Args:
        view: View that converts its images to policy images.
        expert: The teacher, at the policy's delay; None is allowed for recorded labels.

    Raises:
        LogError: The log lacks poses or controls for the labels, or has too few usable frames.
    """
    _require_labels(log, expert, labels)
    counts = dict.fromkeys(("not armed", "no pose", NO_COMMAND, "disturbed", "too far from the path"), 0)
    counts |= {reason: int(count) for reason, count in log.left_out.items()}
    images, states, steering, recorded, stamps = [], [], [], [], []
    first: Rgb | None = None
    differ = False
    for frame in log.frames():
        if why := _unusable(frame, expert, labels):
            counts[why] = counts.get(why, 0) + 1
            continue
        _require_size(frame.image, view, frame.place)
        sent_rad = math.nan if log.unit is None else log.unit.wheel_rad(frame.steering, frame.place)
        first = frame.image if first is None else first
        differ = differ or not np.array_equal(frame.image, first)
        images.append(view.image(frame.image))
        states.append(frame.state)
        recorded.append(sent_rad)
        stamps.append(frame.stamp_ns)
        steering.append(
            sent_rad if labels == "recorded" or expert is None else float(expert.steer(*frame.state))
        )
    if len(images) < LEAST_FRAMES:
        raise too_few_frames(log, LEAST_FRAMES, len(images), counts)
    if not differ:
        raise LogError(
            f"expected images that differ in {log.path}, got {len(images)} equal ones of {log.images}; choose others with --images, or record again"
        )
    count = len(images)
    frames = Frames(
        np.stack(images),
        np.array(states, dtype=np.float64),
        np.array(steering, dtype=np.float32),
        np.zeros((count, 0), np.float32),
        np.zeros(count, bool),
    )
    return RecordedFrames(
        frames, np.array(stamps, np.int64), np.array(recorded, np.float64), str(log.path), counts
    )


def held_out(recording: RecordedFrames) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Numbers of the frames that a training on this log keeps for validation."""
    return FrameSet([recording.frames], True, HOLDOUT_EVERY).held_out[:, 1]


def view_for_camera(camera: Pinhole, distortion: tuple[float, ...] = ()) -> PolicyView:
    """View of a camera, with the same crop fraction as for advnerf's camera."""
    return _cropped_alike(OWN_VIEW, camera, distortion)


def view_for_size(width: int, height: int) -> PolicyView:
    """View for a camera with only a known image size, with the same crop fraction as for advnerf's camera."""
    return view_for_camera(_guessed_camera(width, height))


def view_of(log: DriveLog, view: PolicyView) -> PolicyView:
    """A policy's view for the images of a log: those of another size are cropped at the same fraction, and not undistorted."""
    height, width = log.first_image().shape[:2]
    if (width, height) == (view.camera.width, view.camera.height):
        return view
    return _cropped_alike(view, _guessed_camera(width, height))


def _guessed_camera(width: int, height: int) -> Pinhole:
    return Pinhole(width, height, 0.52 * width, 0.52 * width, 0.5 * width, 0.5 * height)


OWN_VIEW = PolicyView(_guessed_camera(336, 188))


def _cropped_alike(view: PolicyView, camera: Pinhole, distortion: tuple[float, ...] = ()) -> PolicyView:
    """The view of another camera that keeps the same fraction of its image, at the same size of the policy's image."""
    rows, columns = view.window
    top_px, height_px = _same_share(rows, view.camera.height, camera.height)
    left_px, width_px = _same_share(columns, view.camera.width, camera.width)
    return replace(
        view,
        camera=camera,
        distortion=distortion,
        crop_top_px=top_px,
        crop_height_px=height_px,
        crop_left_px=left_px,
        crop_width_px=None if view.crop_width_px is None else width_px,
    )


def _same_share(part: slice, whole_px: int, other_px: int) -> tuple[int, int]:
    """First pixel and number of pixels of the same part of an image of another size."""
    first_px = min(round(part.start * other_px / whole_px), other_px - 1)
    count_px = round((part.stop - part.start) * other_px / whole_px)
    return first_px, max(1, min(count_px, other_px - first_px))


def _require_labels(log: DriveLog, expert: Expert | None, labels: Labels) -> None:
    if labels == "expert" and (expert is None or not log.poses):
        raise LogError(
            f"expected poses in {log.path} for the expert's labels, got none; use --labels recorded"
        )
    if labels == "recorded" and log.unit is None:
        raise LogError(f"expected recorded steering in {log.path}, found none; {log.steering_advice}")


def _unusable(frame: LogFrame, expert: Expert | None, labels: Labels) -> str:
    """Why a frame is not learned from; empty if it is."""
    if frame.unusable:
        return frame.unusable
    if labels == "recorded":
        return NO_COMMAND if math.isnan(frame.steering) else "disturbed" if frame.disturbed else ""
    if math.isnan(frame.state[0]):
        return "no pose"
    far = expert is not None and abs(float(expert.path.project(np.array(frame.state[:2])).cte_m)) > _GIVE_UP_M
    return "too far from the path" if far else ""


def _require_size(rgb: Any, view: PolicyView, place: str) -> None:
    if rgb.shape[:2] != (view.camera.height, view.camera.width):
        raise LogError(
            f"{place}: expected an image of {view.camera.width} x {view.camera.height}, got {rgb.shape[1]} x {rgb.shape[0]};"
            " the images of a log have one size: remove this one"
        )
