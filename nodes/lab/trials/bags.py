"""The numbers of any bag of a drive: where it began and ended is read from the bag itself, so that a trial, an experiment and an
old recording are measured alike.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import yaw_of
from calibration.schema import RoomCalibration, load_calibration
from nodes.bags.reader import extract_attachments, read_info, read_messages
from nodes.lab.trials.evaluation import attack_ids, counterfactual, score, timing, trajectory
from nodes.lab.trials.trial import MOVED_M
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError
from nodes.runtime.messages import decode, ns_from_stamp, pose_matrix
from nodes.runtime.topics import topic as topic_row

_ROOM = "room.yaml"


@dataclass(frozen=True)
class DriveSpan:
    """One armed drive.

    Attributes:
        start_real_ns: Stamp of the first pose that had moved since the arming [ns].
        end_real_ns: When the car was disarmed, or the bag ends [ns].
        reason: Why it was disarmed; empty where the bag ends first.
    """

    start_real_ns: int
    end_real_ns: int
    reason: str


def find_drives(bag: Path) -> list[DriveSpan]:
    """All drives of a bag: from the first motion after an arming to the disarming.

    Raises:
        BagError: The car was never armed, or never moved while it was.
    """
    _require(bag, ("/safety/state", "/vicon/car"))
    armings = _armings(bag)
    if not armings:
        raise BagError(f"expected a bag in which the car is armed, {bag} has no such moment on /safety/state")
    stamps, xy = _positions(bag)
    spans = []
    for armed_ns, disarmed_ns, reason in armings:
        first = int(np.searchsorted(stamps, armed_ns))
        origin = xy[max(first - 1, 0)]
        moved = np.flatnonzero(np.linalg.norm(xy[first:] - origin, axis=1) > MOVED_M)
        start_ns = int(stamps[first + moved[0]]) if moved.size else None
        end_ns = int(stamps[-1]) if disarmed_ns is None else disarmed_ns
        if start_ns is not None and start_ns < end_ns:
            spans.append(DriveSpan(start_ns, end_ns, reason))
    if not spans:
        raise BagError(f"expected the car to move while it is armed, in {bag} it does not")
    return spans


def measure_drive(bag: Path, span: DriveSpan, path: DrivingPath, horizon: Horizon, stopped: str) -> dict[str, Any]:
    """What one drive shows, as plain data: trajectory, cross-track errors, latency, attacks that were shown.

    Args:
        bag: The recording.
        span: Which part of it.
        path: Reference path.
        horizon: What is summed.
        stopped: Why the car was stopped before the horizon's end; empty if it was not. Its last error then holds.
    """
    states = trajectory(bag, span.start_real_ns, horizon)
    stopped_s = (span.end_real_ns - span.start_real_ns) / NS_PER_S if stopped else None
    metrics, held = score(states, path, horizon, stopped_s)
    if len(held) < horizon.ticks + 1:
        raise BagError(
            f"expected {horizon.ticks} ticks of {horizon.dt_s:g} s in {bag}, it ends after {len(states) - 1}"
        )
    found: dict[str, Any] = {
        "attack_ids": sorted(attack_ids(bag)), "states": held.tolist(), "stopped_early": stopped,
        "cte_m": path.project(held[:, :2]).cte_m.tolist(), "total_cte_m": metrics.total_cte_m,
        "mean_abs_cte_m": metrics.mean_cte_m, "max_abs_cte_m": metrics.max_cte_m, "off_track": metrics.off_track,
        "time_to_leave_s": metrics.time_to_leaving_s,
    }  # fmt: skip
    present = {topic.name for topic in read_info(bag).topics}
    if {"/camera/image_raw", "/compositor/image", "/policy/drive", "/safety/drive", "/motor/sent"} <= present:
        # A frame captured less than a tick before the end may rightly find the car disarmed.
        times = timing(bag, span.start_real_ns, span.end_real_ns - round(horizon.dt_s * NS_PER_S))
        found |= {
            "frames": times.frames, "missed": times.missed, "capture_to_serial_ms": times.capture_to_serial_ms.tolist(),
        }  # fmt: skip
    if (compared := counterfactual(bag, span.start_real_ns, span.end_real_ns)) is not None:
        found["counterfactual"] = asdict(compared)
    return found


def evaluate_bag(bag: Path, room: Path | None, ticks: int = 60) -> list[dict[str, Any]]:
    """Measure every drive of a bag against the path of a room file, or of the one that rides along in the bag."""
    return measure_drives(bag, _room_of(bag) if room is None else load_calibration(RoomCalibration, room), ticks)


def measure_drives(bag: Path, room: RoomCalibration, ticks: int) -> list[dict[str, Any]]:
    """Measure every drive of a bag against the path of a room.

    ``unchecked`` says why the numbers may come from damaged messages without a sign of it; empty where checksums cover them.
    """
    wanted = Horizon(ticks, off_track_m=room.off_track_m)
    results = []
    for span in find_drives(bag):
        early = (span.end_real_ns - span.start_real_ns) / NS_PER_S < wanted.ticks * wanted.dt_s
        stopped = (span.reason or "the bag ends") if early else ""
        found = measure_drive(bag, span, room.reference_path, wanted, stopped)
        unchecked = {"unchecked": read_info(bag).unchecked}
        results.append({"bag": str(bag), "start_real_ns": span.start_real_ns, **unchecked, **found})
    return results


def _room_of(bag: Path) -> RoomCalibration:
    if _ROOM not in read_info(bag).attachments:
        raise BagError(f"{bag} carries no {_ROOM}: say which room with --room")
    with tempfile.TemporaryDirectory() as folder:
        (file,) = extract_attachments(bag, Path(folder), [_ROOM])
        return load_calibration(RoomCalibration, file)


def _require(bag: Path, topics: tuple[str, ...]) -> None:
    missing = set(topics) - {topic.name for topic in read_info(bag).topics}
    if missing:
        raise BagError(f"expected {', '.join(topics)} in {bag}, it lacks {', '.join(sorted(missing))}")


def _armings(bag: Path) -> list[tuple[int, int | None, str]]:
    """When the car was armed, when and why disarmed [ns, CLOCK_REALTIME]."""
    spans: list[tuple[int, int | None, str]] = []
    since: int | None = None
    for message in read_messages(bag, ["/safety/state"]):
        state = decode(topic_row("/safety/state").type, message.cdr)
        stamp = ns_from_stamp(state.header.stamp)
        if state.armed and since is None:
            since = stamp
        elif not state.armed and since is not None:
            spans.append((since, stamp, str(state.reason)))
            since = None
    return spans if since is None else [*spans, (since, None, "")]


def _positions(bag: Path) -> tuple[Any, Any]:
    rows = {}
    for message in read_messages(bag, ["/vicon/car"]):
        pose = decode(topic_row("/vicon/car").type, message.cdr)
        T = pose_matrix(pose)
        rows[ns_from_stamp(pose.header.stamp)] = (T[0, 3], T[1, 3], yaw_of(T))
    stamps = sorted(rows)
    return np.array(stamps, np.int64), np.array([rows[stamp][:2] for stamp in stamps])
