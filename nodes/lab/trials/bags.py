"""Evaluates drives in bags. Start and end are read from the bag, so that a trial, an experiment and an old recording are evaluated alike."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.driving.metrics import MOVED_M, Horizon
from advnerf_core.driving.path import Path as DrivingPath
from calibration.schema import RoomCalibration, load_calibration, parse_calibration
from nodes.bags.decoded import read_decoded
from nodes.bags.reader import read_attachments, read_info
from nodes.bags.time_gaps import skipped_gaps
from nodes.lab.trials.evaluation import SHOWN_BY, attack_ids, counterfactual, score, timing, trajectory
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError
from nodes.runtime.messages import pose_matrix, stamp_ns

_ROOM = "room.yaml"


@dataclass(frozen=True)
class DriveSpan:
    """Time span of one armed drive.

    Attributes:
        start_real_ns: Stamp of the first pose that differs from the pose at arming [ns].
        end_real_ns: Time of the disarming, or end of the bag [ns].
        reason: Reason of the disarming; empty if the bag ends first.
    """

    start_real_ns: int
    end_real_ns: int
    reason: str


def find_drives(bag: Path) -> list[DriveSpan]:
    """Find all drives of a bag, each from the first motion after an arming to the disarming.

    Raises:
        BagError: The car was never armed, or never moved while armed.
    """
    _require(bag, ("/safety/state", "/vicon/car"))
    armings = _armings(bag)
    if not armings:
        raise BagError(
            f"expected a bag in which the car is armed, got no armed state on /safety/state in {bag}; give the bag of a drive"
        )
    stamps, xy = _positions(bag)
    spans = []
    gaps = skipped_gaps(bag)
    for armed_ns, disarmed_ns, reason in armings:
        first = int(np.searchsorted(stamps, armed_ns))
        origin = xy[max(first - 1, 0)]
        moved = np.flatnonzero(np.linalg.norm(xy[first:] - origin, axis=1) > MOVED_M)
        start_ns = int(stamps[first + moved[0]]) if moved.size else None
        end_ns = int(stamps[-1]) if disarmed_ns is None else disarmed_ns
        for gap in gaps:  # a drive ends where the clock was set, as later times are not comparable
            if armed_ns <= gap.before_ns < end_ns:
                end_ns, reason = gap.before_ns, str(gap)
        if start_ns is not None and start_ns < end_ns:
            spans.append(DriveSpan(start_ns, end_ns, reason))
    if not spans:
        raise BagError(
            f"expected the car to move while it is armed, got no motion in {bag}; give the bag of a drive"
        )
    return spans


def _ticks_until(stopped_s: float, horizon: Horizon) -> int:
    """Ticks that a drive needs poses for: what comes after its stop is held, and the car may be carried away."""
    return min(horizon.ticks, int(stopped_s / horizon.dt_s) + 2)


def measure_drive(
    bag: Path, span: DriveSpan, path: DrivingPath, horizon: Horizon, stopped: str
) -> dict[str, Any]:
    """Evaluate one drive as plain data: trajectory, cross-track errors, latency, shown attacks.

    Args:
        stopped: Why the car was stopped before the horizon's end; empty if it was not. Its last error is then held.
    """
    stopped_s = (span.end_real_ns - span.start_real_ns) / NS_PER_S if stopped else None
    driven = horizon if stopped_s is None else replace(horizon, ticks=_ticks_until(stopped_s, horizon))
    try:
        states = trajectory(bag, span.start_real_ns, driven)
    except ValueError as error:
        raise BagError(f"the drive at {span.start_real_ns / NS_PER_S:.1f} s of {bag}: {error}") from error
    metrics, held = score(states, path, horizon, stopped_s)
    if len(held) < horizon.ticks + 1:
        raise BagError(
            f"expected {horizon.ticks} ticks of {horizon.dt_s:g} s in {bag}, got {len(states) - 1}; reduce --ticks"
        )
    found: dict[str, Any] = {
        "attack_ids": sorted(attack_ids(bag, SHOWN_BY, span.start_real_ns, span.end_real_ns)),
        "states": held.tolist(),
        "stopped_early": stopped,
        "cte_m": path.project(held[:, :2]).cte_m.tolist(),
        "total_cte_m": metrics.total_cte_m,
        "mean_abs_cte_m": metrics.mean_cte_m,
        "max_abs_cte_m": metrics.max_cte_m,
        "off_track": metrics.off_track,
        "time_to_leave_s": metrics.time_to_leaving_s,
    }
    present = {topic.name for topic in read_info(bag).topics}
    if {"/camera/image_raw", "/compositor/image", "/policy/drive", "/safety/drive", "/motor/sent"} <= present:
        # A frame captured less than a tick before the end may find the car disarmed.
        times = timing(bag, span.start_real_ns, span.end_real_ns - round(horizon.dt_s * NS_PER_S))
        found |= {
            "frames": times.frames,
            "missed": times.missed,
            "capture_to_serial_ms": times.capture_to_serial_ms.tolist(),
        }
    if (compared := counterfactual(bag, span.start_real_ns, span.end_real_ns)) is not None:
        found["counterfactual"] = asdict(compared)
    return found


def evaluate_bag(bag: Path, room: Path | None, ticks: int = 60) -> list[dict[str, Any]]:
    """Evaluate every drive of a bag on the path of a room file, or of the one attached to the bag."""
    return measure_drives(
        bag, _room_of(bag) if room is None else load_calibration(RoomCalibration, room), ticks
    )


def measure_drives(bag: Path, room: RoomCalibration, ticks: int) -> list[dict[str, Any]]:
    """Evaluate every drive of a bag on the path of a room.

    ``unchecked`` says why damage to the messages may go unnoticed; empty if checksums cover them.
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
        raise BagError(f"expected {_ROOM} attached to {bag}, found none; give the room file with --room")
    return parse_calibration(RoomCalibration, read_attachments(bag)[_ROOM], f"{_ROOM} in {bag}")


def _require(bag: Path, topics: tuple[str, ...]) -> None:
    missing = set(topics) - {topic.name for topic in read_info(bag).topics}
    if missing:
        raise BagError(
            f"expected {', '.join(topics)} in {bag}, got no {', '.join(sorted(missing))}; record these topics"
        )


def _armings(bag: Path) -> list[tuple[int, int | None, str]]:
    """Times of arming and disarming [ns, CLOCK_REALTIME], and the reason of the disarming."""
    spans: list[tuple[int, int | None, str]] = []
    since: int | None = None
    for state in read_decoded(bag, "/safety/state"):
        stamp = stamp_ns(state)
        if state.armed and since is None:
            since = stamp
        elif not state.armed and since is not None:
            spans.append((since, stamp, str(state.reason)))
            since = None
    return spans if since is None else [*spans, (since, None, "")]


def _positions(bag: Path) -> tuple[Any, Any]:
    rows = {stamp_ns(pose): pose_matrix(pose)[:2, 3] for pose in read_decoded(bag, "/vicon/car")}
    stamps = sorted(rows)
    return np.array(stamps, np.int64), np.array([rows[stamp] for stamp in stamps])
