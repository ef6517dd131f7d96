"""Reads a bag as a log of a drive: images joined by capture stamp with what was sent to the motor, and with poses.

The wheel angle comes from ``/motor/sent``. A bag of other software has it in an ``AckermannDriveStamped``, whose ``steering_angle`` is in
radians, left positive, by definition of the message. The velocities of a ``Twist`` are no wheel angle.
"""

from __future__ import annotations

import math
import re
import sys
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import islice, pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.logs.choice import LogChoice, LogError
from advnerf_core.data.logs.drive_log import (
    NOWHERE,
    DriveLog,
    LogFrame,
    SteeringUnit,
    chosen_name,
    median_rate_hz,
)
from advnerf_core.geometry import yaw_of
from nodes.bags.images import CAMERA_TOPICS
from nodes.bags.info import BagInfo, BagMessage
from nodes.bags.one_clock import OneClockError, require_one_clock
from nodes.bags.parts import unread_files
from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.stamps import read_stamps
from nodes.bags.time_gaps import LONGEST_SILENCE_S, find_gaps
from nodes.control.pose_buffer import PoseBuffer
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError
from nodes.runtime.image_parts import IMAGE_TYPE
from nodes.runtime.messages import decode, ns_from_stamp, pose_matrix
from nodes.runtime.pictures import COMPRESSED_TYPE, rgb_image
from nodes.runtime.topics import topic as topic_row

CAR_TOPIC = "/vicon/car"
_SAFETY, _SENT, _EXPERT = "/safety/state", "/motor/sent", "/expert/state"
OWN_IMAGES = ("/compositor/image", *CAMERA_TOPICS)
_ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
_LIKE_STEERING = re.compile("ackermann|twist|float|steer|drive|control|cmd", re.IGNORECASE)
_JOIN_S = 0.12
_MOST_BACK_S = 1.0  # messages of one topic may overtake each other, but no clock of a drive goes back
_TIMED = 200  # images from which the rate is determined
_STAMPS = 8  # messages that show whether a topic is stamped
_Time = Callable[[BagMessage, Any], int]
_Span = tuple[int, int]


@dataclass
class _Track:
    """Data of a bag with which images are joined."""

    poses: PoseBuffer = field(default_factory=lambda: PoseBuffer(keep_s=1e6))
    armed: list[tuple[int, bool]] = field(default_factory=list)
    sent: list[tuple[int, float, float]] = field(default_factory=list)
    disturbed: list[tuple[int, bool]] = field(default_factory=list)

    def is_armed(self, stamp_ns: int) -> bool:
        """Whether the car was armed. A bag without states of the safety node counts as armed throughout."""
        return not self.armed or bool(_last(self.armed, stamp_ns))

    def is_disturbed(self, stamp_ns: int) -> bool:
        return bool(self.disturbed) and bool(_last(self.disturbed, stamp_ns))

    def command(self, stamp_ns: int) -> tuple[float, float]:
        """Steering [rad] and speed [m/s] that were sent for an image, found by its stamp, or else the first command after it."""
        index = bisect_left(self.sent, (stamp_ns, -math.inf, -math.inf))
        if index == len(self.sent) or self.sent[index][0] - stamp_ns > _JOIN_S * NS_PER_S:
            return math.nan, math.nan
        return self.sent[index][1:]

    def state(self, stamp_ns: int) -> tuple[float, float, float]:
        """x [m], y [m], yaw [rad] of the car; NaN without a pose."""
        pose = self.poses.at(stamp_ns, 0.0)
        return NOWHERE if pose is None else (float(pose.T[0, 3]), float(pose.T[1, 3]), yaw_of(pose.T))


def read_bag_log(bag: Path, choice: LogChoice) -> DriveLog:
    """Describe a bag.

    Args:
        bag: Bag folder or file, of any software.
        choice: Answers of the user; images and steering are topics.

    Raises:
        BagError: The bag cannot be read.
        LogError: The bag lacks the chosen topics, or any images.
    """
    info = read_info(bag)
    counts = {topic.name: topic.count for topic in info.topics if topic.count}
    typed = {topic.name: topic.type for topic in info.topics if topic.count}
    found = [name for name, kind in typed.items() if kind in (IMAGE_TYPE, COMPRESSED_TYPE)]
    cameras = tuple(
        sorted(
            found, key=lambda name: (OWN_IMAGES.index(name) if name in OWN_IMAGES else len(OWN_IMAGES), name)
        )
    )
    images = chosen_name(choice.images, cameras, "images", bag)
    controls = tuple(name for name, kind in typed.items() if name == _SENT or kind == _ACKERMANN)
    controls = tuple(sorted(controls, key=lambda name: (name != _SENT, name)))
    without_controls = _without_controls(typed)
    if choice.steering is not None and not controls:
        raise LogError(
            f"expected a topic with wheel angles in {bag}, got {choice.steering}; {without_controls}"
        )
    steering = _steering_topic(choice.steering, controls, bag)
    joined = [name for name in (CAR_TOPIC, _SAFETY, _EXPERT) if name in counts]
    kinds = {images: IMAGE_TYPE, **({steering: _steering_type(steering)} if steering else {})}
    others = [name for name in cameras if name != images]
    with _naming(others):
        first_ns = _first_stamps(bag, kinds)
    unstamped = [topic for topic, times in first_ns.items() if len(times) > 1 and len(set(times)) == 1]
    if not unstamped:
        try:
            require_one_clock(bag, [*kinds, *joined])
        except OneClockError as error:
            raise LogError(str(error)) from error
    time_ns = _recorded_ns if unstamped else _stamped_ns
    spans = cache(partial(_spans, info, [*joined, *([steering] if steering else [])] or [images]))
    track = cache(lambda: _read_track(bag, steering, joined, time_ns, spans()))
    return DriveLog(
        bag,
        _format(info),
        info.parts,
        images,
        cameras,
        controls,
        SteeringUnit(steering, 1.0, "left").chosen(choice) if steering else None,
        counts[images],
        _rate_hz(bag, images, images in unstamped),
        counts.get(CAR_TOPIC, 0),
        lambda: np.array([each[1] for each in track().sent], np.float64),
        lambda: _frames(bag, images, others, track(), time_ns, spans()),
        labels="expert" if counts.get(CAR_TOPIC) else "recorded",
        attached=lambda: read_attachments(bag) if info.attachments else {},
        unchecked=info.unchecked,
        notes=_notes(bag, unstamped),
        without_controls=without_controls,
    )


@contextmanager
def _naming(others: Sequence[str]) -> Iterator[None]:
    """Name the other images of a bag if the chosen ones, such as depths, cannot be shown: ``policy log info`` would list them."""
    try:
        yield
    except MessageError as error:
        if not others:
            raise
        raise LogError(f"{error}; or choose other images with --images: {', '.join(others)}") from error


def _rate_hz(bag: Path, images: str, unstamped: bool) -> float:
    """Images per second, by their stamps: a link may deliver them in bursts."""
    messages, stamp_of = islice(read_messages(bag, [images], as_recorded=True), _TIMED), read_stamps(bag)
    return median_rate_hz([(each.log_ns if unstamped else stamp_of(each)) / NS_PER_S for each in messages])


def _format(info: BagInfo) -> str:
    return f"bag ({info.parts[0].suffix[1:]})"


def _steering_topic(wanted: str | None, controls: tuple[str, ...], bag: Path) -> str | None:
    if wanted is not None or _SENT in controls or len(controls) == 1:
        return chosen_name(wanted, controls, "a topic with wheel angles", bag)
    return None


def _notes(bag: Path, unstamped: list[str]) -> tuple[str, ...]:
    found = []
    if unstamped:
        found.append(
            f"images and steering are joined by times of recording, as all stamps on {' and '.join(unstamped)} are equal"
        )
    if unread := unread_files(bag):
        found.append(unread)
    return tuple(found)


def _without_controls(types: Mapping[str, str]) -> str:
    """What to do about a bag without wheel angles.

    Args:
        types: Types by topic.
    """
    others = [f"{name} ({kind})" for name, kind in types.items() if _LIKE_STEERING.search(f"{name} {kind}")]
    return (
        f"wheel angles are read from {_ACKERMANN}, the bag has {', '.join(others) or 'nothing like it'}; "
        "convert the messages, or write the images and a CSV file with the wheel angles"
    )


def _steering_type(topic: str) -> str:
    return topic_row(topic).type if topic == _SENT else _ACKERMANN


def _first_stamps(bag: Path, kinds: Mapping[str, str]) -> dict[str, list[int]]:
    """Stamps [ns] of the first messages of topics. If all are equal, as of a node that leaves them at zero, they join nothing.

    Args:
        kinds: Types by topic.
    """
    found = {}
    for topic, kind in kinds.items():
        messages = islice(read_messages(bag, [topic], types={topic: kind}), _STAMPS)
        found[topic] = [_stamped_ns(each, decode(kind, each.cdr)) for each in messages]
    return found


def _stamped_ns(message: BagMessage, decoded: Any) -> int:
    del message
    return ns_from_stamp(decoded.header.stamp)


def _recorded_ns(message: BagMessage, decoded: Any) -> int:
    del decoded
    return message.log_ns


def _refuse_going_back(latest_ns: dict[str, int], topic: str, stamp_ns: int, place: str) -> None:
    """Two drives whose stamps overlap cannot be told apart: an image would be joined with the steering of the other one.

    Args:
        latest_ns: The latest stamp of each topic so far; updated.
    """
    latest_ns[topic] = max(stamp_ns, latest_ns.get(topic, stamp_ns))
    if (back_s := (latest_ns[topic] - stamp_ns) / NS_PER_S) > _MOST_BACK_S:
        raise LogError(
            f"{place}: expected stamps that go forward, got one {back_s:.3g} s before an earlier one; "
            "cut the bag there, or record again with one clock"
        )


def _frames(
    bag: Path, images: str, others: Sequence[str], track: _Track, time_ns: _Time, spans: Sequence[_Span]
) -> Iterator[LogFrame]:
    latest_ns: dict[str, int] = {}
    seen_ns: dict[int, str] = {}
    for number, (stamp_ns, rgb) in enumerate(_pictures(bag, images, others, time_ns, spans)):
        place = f"{bag}, image {number}"
        _refuse_going_back(latest_ns, images, stamp_ns, place)
        if (earlier := seen_ns.setdefault(stamp_ns, place)) != place and time_ns is _stamped_ns:
            raise LogError(
                f"{place}: expected a stamp that no other image has, as it is joined with the steering by it, got that of {earlier}; "
                "remove one of them, or record again with a stamp for each image"
            )
        steering_rad, speed_mps = track.command(stamp_ns)
        yield LogFrame(
            rgb,
            stamp_ns,
            steering_rad,
            place,
            speed_mps,
            track.state(stamp_ns),
            "" if track.is_armed(stamp_ns) else "not armed",
            track.is_disturbed(stamp_ns),
        )


def _pictures(
    bag: Path, images: str, others: Sequence[str], time_ns: _Time, spans: Sequence[_Span]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Time [ns] and RGB ``[H, W, 3]`` of each image."""
    with _naming(others):
        for stamp_ns, _, image in _read(bag, {images: IMAGE_TYPE}, time_ns, spans):
            yield stamp_ns, rgb_image(image, f"{images} in {bag}")


def _spans(info: BagInfo, topics: Sequence[str]) -> list[_Span]:
    """Spans of log time between which the recorder's clock was set: their order is not that of the drive."""
    edges_ns = [0, sys.maxsize]
    if info.duration_s > LONGEST_SILENCE_S:
        gaps = find_gaps([each.log_ns for each in read_messages(info.path, topics, as_recorded=True)])
        edges_ns[1:1] = [(gap.before_ns + gap.after_ns) // 2 for gap in gaps]
    return list(pairwise(edges_ns))


def _read(
    bag: Path, kinds: Mapping[str, str], time_ns: _Time, spans: Sequence[_Span]
) -> Iterator[tuple[int, str, Any]]:
    """Time [ns], topic and message in order of the log time, but the spans in order of their first time."""
    parts = [partial(_read_span, bag, kinds, time_ns, span) for span in spans]
    if len(parts) > 1:
        parts.sort(key=lambda part: next((time for time, _, _ in part()), 0))
    for part in parts:
        yield from part()


def _read_span(
    bag: Path, kinds: Mapping[str, str], time_ns: _Time, span: _Span
) -> Iterator[tuple[int, str, Any]]:
    messages = read_messages(bag, list(kinds), types=kinds)
    for message in takewhile(lambda each: each.log_ns < span[1], messages):
        if message.log_ns >= span[0]:
            decoded = decode(kinds[message.topic], message.cdr)
            yield time_ns(message, decoded), message.topic, decoded


def _read_track(
    bag: Path, steering: str | None, topics: list[str], time_ns: _Time, spans: Sequence[_Span]
) -> _Track:
    track = _Track()
    kinds = {topic: topic_row(topic).type for topic in topics}
    kinds |= {steering: _steering_type(steering)} if steering else {}
    latest_ns: dict[str, int] = {}
    for stamp_ns, topic, message in _read(bag, kinds, time_ns, spans) if kinds else ():
        _refuse_going_back(latest_ns, topic, stamp_ns, f"{bag}, {topic}")
        _add(track, topic, kinds[topic], message, stamp_ns)
    for stream in (track.armed, track.sent, track.disturbed):
        stream.sort()
    return track


def _add(track: _Track, topic: str, kind: str, message: Any, stamp_ns: int) -> None:
    if topic == CAR_TOPIC:
        track.poses.add(stamp_ns, pose_matrix(message))
    elif topic == _SAFETY:
        track.armed.append((stamp_ns, bool(message.armed)))
    elif topic == _EXPERT:
        track.disturbed.append((stamp_ns, message.disturbance_rad != 0.0))
    elif kind == _ACKERMANN:
        track.sent.append((stamp_ns, float(message.drive.steering_angle), float(message.drive.speed)))
    elif not message.braking:
        # A policy's drive has the image's stamp. An expert's drive has the stamp of a pose just after it.
        track.sent.append((stamp_ns, float(message.steering_rad), float(message.speed_mps)))


def _last(stream: list[tuple[int, bool]], stamp_ns: int) -> bool:
    index = bisect_left(stream, (stamp_ns + 1,)) - 1
    return stream[index][1] if index >= 0 else False
