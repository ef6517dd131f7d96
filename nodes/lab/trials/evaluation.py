"""Metrics of a drive in a bag: trajectory at the control ticks, cross-track error, latency from capture to serial write."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.driving.metrics import DriveMetrics, Horizon, drive_metrics, states_at_ticks
from advnerf_core.driving.path import Array
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import yaw_of
from nodes.bags.decoded import read_decoded
from nodes.bags.reader import read_info, read_messages
from nodes.bags.time_gaps import require_order
from nodes.runtime.errors import BagError
from nodes.runtime.messages import decode, ns_from_stamp, pose_matrix
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import topic as topic_row

# Derived messages have the capture stamp of their image, so each hop is publish time minus that stamp.
HOPS = {
    "camera": "/camera/image_raw",
    "compositor": "/compositor/image",
    "policy": "/policy/drive",
    "safety": "/safety/drive",
}
SENT = "/motor/sent"
# Topics on which nodes report that they show an attack, with its id.
_IN_IMAGES = "/compositor/attack"
SHOWN_BY = (_IN_IMAGES, "/monitor/attack")
_CAR, _SEEN = "/vicon/car", "/compositor/image"
COUNTERFACTUAL = "/policy/counterfactual"
_NS_PER_MS = 1e6


@dataclass(frozen=True)
class Counterfactual:
    """Steering that the attack added during a drive, image by image; see `nodes.counterfactual`.

    Attributes:
        frames: Number of compared images.
        frames_drawn: Number of images into which the attack was drawn.
        mean_abs_delta_rad: Mean absolute difference over the images with the attack [rad]; None without any.
        mean_delta_rad: Mean difference over these images, left positive [rad]; None without any.
        max_abs_delta_rad: Largest absolute difference [rad].
        max_at_s: Time of the largest difference since the start [s].
    """

    frames: int
    frames_drawn: int
    mean_abs_delta_rad: float | None
    mean_delta_rad: float | None
    max_abs_delta_rad: float
    max_at_s: float


@dataclass(frozen=True, eq=False)
class Timing:
    """Timing of one drive.

    Attributes:
        capture_to_serial_ms: Delay from capture to the write to the serial port, per frame that reached the controller, ``[n]`` [ms].
        hops_ms: Delay from capture to publication by each node, per frame [ms].
        frames: Number of frames captured during the drive.
        missed: Number of frames for which no drive command was written to the serial port.
    """

    capture_to_serial_ms: Array
    hops_ms: dict[str, Array]
    frames: int
    missed: int


def trajectory(bag: Path, start_real_ns: int, horizon: Horizon) -> Array:
    """Read the states ``[K, 3]`` of the rear axle at the control ticks from motion capture. Tick 0 is at ``start_real_ns``.

    Raises:
        BagError: There are no poses, or a recorder whose clock was set back has mixed them.
    """
    stamps: list[int] = []
    numbers: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for recorded in read_messages(bag, [_CAR]):
        numbers.append(recorded.sequence)
        message = decode(topic_row(_CAR).type, recorded.cdr)
        stamp_ns = ns_from_stamp(message.header.stamp)
        if stamps and stamp_ns <= stamps[-1]:
            continue
        T = pose_matrix(message)
        stamps.append(stamp_ns)
        poses.append((T[0, 3], T[1, 3], yaw_of(T)))
    require_order(bag, _CAR, numbers)
    if len(stamps) < 2:
        raise BagError(f"expected a stream of poses on {_CAR} in {bag}, got {len(stamps)}")
    return states_at_ticks(np.array(stamps), np.array(poses), start_real_ns, horizon)


def score(
    states: Array, path: DrivingPath, horizon: Horizon, stopped_after_s: float | None
) -> tuple[DriveMetrics, Array]:
    """Compute the metrics of a drive, and the states ``[ticks + 1, 3]``, with the last state held after an early stop."""
    stopped = None if stopped_after_s is None else horizon.whole_ticks(stopped_after_s)
    metrics = drive_metrics(path, states, horizon, stopped)
    seen = len(states) if stopped is None else min(len(states), max(stopped, 1) + 1)
    held = np.repeat(states[seen - 1 : seen], max(0, horizon.ticks + 1 - seen), axis=0)
    return metrics, np.concatenate([states[:seen], held])[: horizon.ticks + 1]


def timing(bag: Path, start_real_ns: int, end_real_ns: int) -> Timing:
    """Compute the latency of every frame captured between two times [ns, CLOCK_REALTIME]."""
    captured = [stamp for stamp, _ in _stamps(bag, HOPS["camera"]) if start_real_ns <= stamp < end_real_ns]
    inside = set(captured)
    written = {at: age / _NS_PER_MS for at, age in command_ages_ns(bag).items() if at in inside}
    hops = {
        name: np.array(
            [(published - stamp) / _NS_PER_MS for stamp, published in _stamps(bag, topic) if stamp in inside]
        )
        for name, topic in HOPS.items()
    }
    return Timing(np.array(list(written.values())), hops, len(captured), len(inside - written.keys()))


def command_ages_ns(bag: Path) -> dict[int, int]:
    """Time from the capture of every image that became a command to its first serial write, by its capture stamp [ns]."""
    ages: dict[int, int] = {}
    for message in read_decoded(bag, SENT):
        stamp_ns = ns_from_stamp(message.header.stamp)
        if not message.braking:
            ages.setdefault(stamp_ns, int(message.serial_write_real_ns) - stamp_ns)
    return ages


def frames(bag: Path, start_real_ns: int, count: int, period_s: float = 0.1) -> NDArray[np.uint8]:
    """Read the policy's images at the control ticks, ``[count, H, W, 3]``: the newest image at each tick."""
    stamps, images = [], []
    for message in read_decoded(bag, _SEEN):
        stamps.append(ns_from_stamp(message.header.stamp))
        images.append(rgb_image(message, f"{_SEEN} in {bag}").copy())
    if not images:
        raise BagError(f"expected images on {_SEEN} in {bag}, got none")
    ticks = start_real_ns + np.arange(count) * round(period_s * 1e9)
    newest = np.clip(np.searchsorted(stamps, ticks, side="right") - 1, 0, len(images) - 1)
    return np.stack([images[index] for index in newest])


def attack_ids(
    bag: Path, topics: Sequence[str] = SHOWN_BY, start_real_ns: int = 0, end_real_ns: int = 2**63
) -> set[str]:
    """Ids of the attacks that were drawn into at least one frame, or shown on the monitor, between two times [ns, CLOCK_REALTIME]."""
    present = {topic.name for topic in read_info(bag).topics}
    found = set[str]()
    for name in (each for each in topics if each in present):
        labels = [(ns_from_stamp(m.header.stamp), str(m.attack_id), m.drawn) for m in read_decoded(bag, name)]
        # The label of an image is for that image; a screen shows the same until its next label.
        ends = [at for at, _, _ in labels]
        ends = ends if name == _IN_IMAGES else [*ends[1:], end_real_ns][: len(labels)]
        found |= {
            attack_id
            for (at, attack_id, drawn), end in zip(labels, ends, strict=True)
            if drawn and at < end_real_ns and end >= start_real_ns
        }
    return found


def why_not_shown(bag: Path, start_real_ns: int = 0, end_real_ns: int = 2**63) -> str:
    """The reason that most labels without an attack give, between two times [ns, CLOCK_REALTIME], and how many of all labels give it."""
    present = {topic.name for topic in read_info(bag).topics}
    labels = [
        label
        for name in SHOWN_BY
        if name in present
        for label in read_decoded(bag, name)
        if start_real_ns <= ns_from_stamp(label.header.stamp) < end_real_ns
    ]
    reasons = Counter(str(label.reason) for label in labels if not label.drawn)
    if not reasons:
        return f"none of {len(labels)} labels says why"
    reason, count = reasons.most_common(1)[0]
    return f"{count} of {len(labels)} labels say {reason!r}"


def counterfactual(bag: Path, start_real_ns: int, end_real_ns: int) -> Counterfactual | None:
    """Compute the steering that the attack added between two times [ns, CLOCK_REALTIME]; None without a counterfactual node."""
    if COUNTERFACTUAL not in {topic.name for topic in read_info(bag).topics}:
        return None
    rows = [
        (stamp, float(message.delta_rad), bool(message.drawn))
        for message in read_decoded(bag, COUNTERFACTUAL)
        if start_real_ns <= (stamp := ns_from_stamp(message.header.stamp)) < end_real_ns
    ]
    if not rows:
        return None
    delta, drawn = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    worst = int(np.abs(delta).argmax())
    return Counterfactual(
        len(rows),
        int(drawn.sum()),
        float(np.abs(delta[drawn]).mean()) if drawn.any() else None,
        float(delta[drawn].mean()) if drawn.any() else None,
        float(np.abs(delta[worst])),
        (rows[worst][0] - start_real_ns) / 1e9,
    )


def _stamps(bag: Path, topic: str) -> Iterator[tuple[int, int]]:
    """Yield capture stamp and publish time of every message [ns]."""
    typename = topic_row(topic).type
    for message in read_messages(bag, [topic]):
        yield ns_from_stamp(decode(typename, message.cdr).header.stamp), message.publish_ns
