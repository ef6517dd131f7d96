"""Takes training frames from recordings: images joined with steering by capture stamp.

Only images captured while the car was armed are used. The label is either the expert's steering at the measured pose (so every bag
with poses is a DAgger round, no matter which driver recorded it), or the command sent to the motor controller. Disturbances that the
expert added to its steering are in neither: they are not in the expert's control law, and ``recorded`` skips such frames.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import read_stored
from advnerf_core.documents import CsvRow, raise_problems, read_csv
from advnerf_core.driving.expert import Expert
from advnerf_core.geometry import Pinhole, yaw_of
from advnerf_core.learning.frames import Frames
from advnerf_core.policies.view import PolicyView
from nodes.bags.images import CAMERA_TOPICS, image_messages, image_topic
from nodes.bags.reader import read_info, read_messages
from nodes.control.pose_buffer import PoseBuffer
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import decode, ns_from_stamp, pose_matrix
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import topic as topic_row

Labels = Literal["expert", "recorded"]
_CAR, _SAFETY, _SENT, _EXPERT = "/vicon/car", "/safety/state", "/motor/sent", "/expert/state"
_IMAGES = ("/compositor/image", *CAMERA_TOPICS)
_JOIN_S = 0.12
_GIVE_UP_M = 0.7


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


@dataclass
class _Track:
    """Data of a bag with which images are joined."""

    poses: PoseBuffer = field(default_factory=lambda: PoseBuffer(keep_s=1e6))
    armed: list[tuple[int, bool]] = field(default_factory=list)
    sent: list[tuple[int, float]] = field(default_factory=list)
    disturbed: list[tuple[int, bool]] = field(default_factory=list)

    def is_armed(self, stamp_ns: int) -> bool:
        """Whether the car was armed. A bag without states of the safety node counts as armed throughout."""
        return not self.armed or bool(_last(self.armed, stamp_ns))

    def is_disturbed(self, stamp_ns: int) -> bool:
        return bool(self.disturbed) and bool(_last(self.disturbed, stamp_ns))

    def steering_rad(self, stamp_ns: int) -> float:
        """Steering [rad] that was sent for an image, found by its stamp, or else the first command sent after it."""
        index = bisect_left(self.sent, (stamp_ns, -math.inf))
        if index == len(self.sent) or self.sent[index][0] - stamp_ns > _JOIN_S * NS_PER_S:
            return math.nan
        return self.sent[index][1]


def frames_of_bag(
    bag: Path,
    view: PolicyView,
    expert: Expert | None,
    labels: Labels = "expert",
    images_on: str | None = None,
) -> RecordedFrames:
    """Take the frames of a bag.

    Args:
        bag: Bag folder or file.
        view: View that converts camera images to policy images.
        expert: The teacher, at the policy's delay; None is allowed for recorded labels.
        labels: Source of the labels.
        images_on: Topic of the images, raw or compressed; None uses the compositor's, or else the camera's.
    """
    counts_of = {topic.name: topic.count for topic in read_info(bag).topics}
    topic = image_topic(bag, [images_on] if images_on else _IMAGES)
    if labels == "expert" and (expert is None or not counts_of.get(_CAR)):
        raise BagError(
            f"expected poses on {_CAR} in {bag} for the expert's labels, got none; use --labels recorded"
        )
    track = _read_track(bag, [t for t in (_CAR, _SAFETY, _SENT, _EXPERT) if counts_of.get(t)])
    counts = dict.fromkeys(("not armed", "no pose", "no command", "disturbed", "too far from the path"), 0)
    images, states, steering, recorded, stamps = [], [], [], [], []
    for image in image_messages(bag, topic):
        stamp_ns = ns_from_stamp(image.header.stamp)
        sent_rad = track.steering_rad(stamp_ns)
        state, why = _usable(track, stamp_ns, sent_rad, expert, labels)
        if why:
            counts[why] += 1
            continue
        rgb = rgb_image(image, f"{topic} in {bag}")
        _require_size(rgb, view, str(bag))
        images.append(view.image(rgb))
        states.append(state)
        recorded.append(sent_rad)
        stamps.append(stamp_ns)
        steering.append(sent_rad if labels == "recorded" or expert is None else float(expert.steer(*state)))
    if len(images) < 4:
        why = ", ".join(f"{count} {reason}" for reason, count in counts.items() if count)
        raise BagError(
            f"expected at least 4 usable frames in {bag}, got {len(images)} ({why or 'no images at all'})"
        )
    return _recording(images, states, steering, recorded, stamps, str(bag), counts)


def frames_of_log(
    log: Path, view: PolicyView | None, image_column: str, steering_column: str, rad_per_unit: float = 1.0
) -> tuple[RecordedFrames, PolicyView]:
    """Take the frames of a foreign log: a CSV file with a header and one row per image. Image paths are relative to the file.

    Args:
        view: View that converts its images to policy images; None uses the same crop fraction as for advnerf's camera.
        image_column: Column with the image files.
        steering_column: Column with the steering.
        rad_per_unit: Factor from that column to radians, left positive (negative for logs in which right is positive).
    """
    images, steering = [], []
    problems: list[str] = []
    for row in read_csv(log, (image_column, steering_column)):
        try:
            angle_rad = _angle_rad(row, steering_column, rad_per_unit)
            rgb = _picture(row, log.parent, image_column)
        except ConfigError as error:
            problems.append(str(error))
            continue
        view = view or view_for_size(rgb.shape[1], rgb.shape[0])
        _require_size(rgb, view, str(log))
        images.append(view.image(rgb))
        steering.append(angle_rad)
    raise_problems(problems)
    if len(images) < 4 or view is None:
        raise ConfigError(f"expected at least 4 rows in {log}, got {len(images)}; record more")
    nowhere = [(math.nan,) * 3] * len(images)
    return _recording(images, nowhere, steering, steering, list(range(len(images))), str(log), {}), view


def _angle_rad(row: CsvRow, column: str, rad_per_unit: float) -> float:
    angle_rad = row.number(column) * rad_per_unit
    if not abs(angle_rad) < 1.0:
        raise ConfigError(
            f"{row.place}: expected a steering angle below 1 rad, got {row.values[column]!r} times {rad_per_unit:g};"
            " give the factor from the log's unit to radians with --log-scale"
        )
    return angle_rad


def _picture(row: CsvRow, folder: Path, column: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    try:
        rgb, _ = read_stored(folder / row.values[column].strip())
    except DatasetError as error:
        raise ConfigError(f"{row.place}: {error}, or remove the row") from error
    return rgb


def view_for_size(width: int, height: int) -> PolicyView:
    """View for a camera with only a known image size, with the same crop fraction as for advnerf's camera."""
    camera = Pinhole(width, height, 0.52 * width, 0.52 * width, 0.5 * width, 0.5 * height)
    return PolicyView(camera, round(height * 24 / 188), round(height * 111 / 188))


def first_image(log: Path, image_column: str) -> Path:
    """Path of the first image of a foreign log."""
    for row in read_csv(log, (image_column,)):
        return log.parent / row.values[image_column].strip()
    raise ConfigError(f"expected at least 4 rows in {log}, got none; give a log with images")


def _read_track(bag: Path, topics: list[str]) -> _Track:
    track = _Track()
    for message in read_messages(bag, topics) if topics else ():
        decoded = decode(topic_row(message.topic).type, message.cdr)
        stamp_ns = ns_from_stamp(decoded.header.stamp)
        if message.topic == _CAR:
            track.poses.add(stamp_ns, pose_matrix(decoded))
        elif message.topic == _SAFETY:
            track.armed.append((stamp_ns, bool(decoded.armed)))
        elif message.topic == _EXPERT:
            track.disturbed.append((stamp_ns, decoded.disturbance_rad != 0.0))
        elif not decoded.braking:
            # A policy's drive has the image's stamp. An expert's drive has the stamp of a pose just after it.
            track.sent.append((stamp_ns, float(decoded.steering_rad)))
    for stream in (track.armed, track.sent, track.disturbed):
        stream.sort()
    return track


def _usable(
    track: _Track, stamp_ns: int, sent_rad: float, expert: Expert | None, labels: Labels
) -> tuple[tuple[float, float, float], str]:
    nowhere = (math.nan, math.nan, math.nan)
    if not track.is_armed(stamp_ns):
        return nowhere, "not armed"
    if labels == "recorded" and math.isnan(sent_rad):
        return nowhere, "no command"
    if labels == "recorded" and track.is_disturbed(stamp_ns):
        return nowhere, "disturbed"
    pose = track.poses.at(stamp_ns, 0.0)
    if pose is None:
        return nowhere, "no pose" if labels == "expert" else ""
    state = (float(pose.T[0, 3]), float(pose.T[1, 3]), yaw_of(pose.T))
    far = expert is not None and abs(float(expert.path.project(np.array(state[:2])).cte_m)) > _GIVE_UP_M
    return state, "too far from the path" if far else ""


def _recording(
    images: Any, states: Any, steering: Any, recorded: Any, stamps: Any, name: str, counts: Any
) -> RecordedFrames:
    count = len(images)
    frames = Frames(
        np.stack(images),
        np.array(states, dtype=np.float64),
        np.array(steering, dtype=np.float32),
        np.zeros((count, 0), np.float32),
        np.zeros(count, bool),
    )
    return RecordedFrames(frames, np.array(stamps, np.int64), np.array(recorded, np.float64), name, counts)


def _require_size(rgb: Any, view: PolicyView, source: str) -> None:
    if rgb.shape[:2] != (view.camera.height, view.camera.width):
        raise ConfigError(
            f"expected images of {view.camera.width} x {view.camera.height} in {source}, got {rgb.shape[1]} x {rgb.shape[0]};"
            " give the calibration of its camera with --camera"
        )


def _last(stream: list[tuple[int, bool]], stamp_ns: int) -> bool:
    index = bisect_left(stream, (stamp_ns + 1,)) - 1
    return stream[index][1] if index >= 0 else False
