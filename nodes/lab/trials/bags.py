"""Evaluates drives in bags. Start and end are read from the bag, so that a trial, an experiment and an old recording are evaluated alike."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from advnerf_core.documents import decode_text, parse_yaml
from advnerf_core.driving.metrics import MOVED_M, Horizon, PoseGapError
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import Array
from calibration.schema import RoomCalibration, load_calibration, parse_calibration
from nodes.bags.decoded import read_decoded
from nodes.bags.one_clock import require_one_clock
from nodes.bags.reader import read_attachment, read_attachments, read_info, read_messages
from nodes.bags.time_gaps import skipped_gaps
from nodes.control.arming_gates import NOT_HELD
from nodes.control.stop_causes import SAFETY_SILENT_S, is_result, safety_silence
from nodes.lab.trials.evaluation import SHOWN_BY, attack_ids, counterfactual, score, timing, trajectory
from nodes.launching.launched import facts_of
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError
from nodes.runtime.messages import pose_matrix, stamp_ns
from nodes.runtime.paths import RESOLVED_NAME

_ROOM, _CAR, _SAFETY = "room.yaml", "/vicon/car", "/safety/state"
_ACTS, _LET_GO = "/operator/act", "let_go"
# A drive begins with a car that stands: without an arming before it, this long [s].
_STOOD_S = 1.0
# At the edges of a gap, messages of one moment may have crossed the link or not [s].
_EDGE_S = 0.1
# Between the page's word about a button and the disarming that follows; the two may be on two hosts [s].
_TOGETHER_S = 1.0
_BAG_ENDS = "the bag ends while the car drives"
_BEGUN_LATE = "the recording began while the car was driving, so that the drive has no beginning"
_TOTALS = ("total_cte_m", "mean_abs_cte_m", "max_abs_cte_m", "off_track", "time_to_leave_s")


@dataclass(frozen=True)
class DriveSpan:
    """Time span of one armed drive.

    Attributes:
        start_real_ns: Stamp of the first pose that differs from the pose at arming [ns].
        end_real_ns: Time of the disarming, or end of the bag [ns].
        reason: Reason of the disarming, or that the bag ends first.
    """

    start_real_ns: int
    end_real_ns: int
    reason: str


def find_drives(bag: Path) -> list[DriveSpan]:
    """Find all drives of a bag, each from the first motion after an arming to the disarming. One whose beginning is not in the bag is left out, and told.

    Raises:
        BagError: The car was never armed, never moved while armed, or was driving when the recording began.
    """
    _require(bag, (_SAFETY, _CAR))
    require_one_clock(bag, (_SAFETY, _CAR))
    stamps, xy = _positions(bag)
    armings = _armings(bag, int(stamps[-1]) if len(stamps) else 0)
    if not armings:
        raise BagError(
            f"expected a bag in which the car is armed, got no armed state on /safety/state in {bag}; give the bag of a drive"
        )
    spans, begun_late = list[DriveSpan](), False
    gaps, let_go = skipped_gaps(bag), _made_to_let_go(bag)
    for arming in armings:
        start_ns = _first_motion_ns(stamps, xy, arming.since_ns)
        end_ns = int(stamps[-1]) if arming.until_ns is None else arming.until_ns
        reason = _BAG_ENDS if arming.until_ns is None else _why_disarmed(arming.reason, end_ns, let_go)
        for gap in gaps:  # a drive ends where the clock was set, as later times are not comparable
            if arming.since_ns <= gap.before_ns < end_ns:
                end_ns, reason = gap.before_ns, str(gap)
        if start_ns is None or start_ns >= end_ns:
            continue
        if arming.is_seen or start_ns - max(arming.since_ns, int(stamps[0])) >= _STOOD_S * NS_PER_S:
            spans.append(DriveSpan(start_ns, end_ns, reason))
            continue
        begun_late = True
        print(f"{bag}: {_BEGUN_LATE}; it is left out", file=sys.stderr, flush=True)
    if not spans:
        raise BagError(
            f"expected a drive from its beginning in {bag}, but {_BEGUN_LATE}; record from before the car is armed"
            if begun_late
            else f"expected the car to move while it is armed, got no motion in {bag}; give the bag of a drive"
        )
    return spans


def _first_motion_ns(stamps: Array, xy: Array, armed_ns: int) -> int | None:
    """Stamp of the first pose that differs from the one at arming [ns]; None for a car that stood."""
    first = int(np.searchsorted(stamps, armed_ns))
    moved = np.flatnonzero(np.linalg.norm(xy[first:] - xy[max(first - 1, 0)], axis=1) > MOVED_M)
    return int(stamps[first + moved[0]]) if moved.size else None


def _ticks_until(stopped_s: float, horizon: Horizon) -> int:
    """Ticks that a drive needs poses for: what comes after its stop is held, and the car may be carried away."""
    return min(horizon.ticks, max(1, horizon.whole_ticks(stopped_s)))


def measure_drive(
    bag: Path, span: DriveSpan, path: DrivingPath, horizon: Horizon, stopped: str
) -> dict[str, Any]:
    """Evaluate one drive as plain data: trajectory, cross-track errors, latency, shown attacks.

    Args:
        stopped: Why the car was stopped before the horizon's end; empty if it was not. Its last error is then held. If a fault of the stack
            stopped it, or the bag ends, the drive does not count and has no totals. One whose poses are missing has no states either.
    """
    stopped_s = (span.end_real_ns - span.start_real_ns) / NS_PER_S if stopped else None
    driven = horizon if stopped_s is None else replace(horizon, ticks=_ticks_until(stopped_s, horizon))
    try:
        states = trajectory(bag, span.start_real_ns, driven)
    except PoseGapError as gap:
        return _without_poses(bag, span, horizon, gap)
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
        "counts": is_result(stopped),
        "driven_ticks": horizon.ticks - metrics.held_ticks,
        "cte_m": path.project(held[:, :2]).cte_m.tolist(),
        **dict.fromkeys(_TOTALS),
    }
    if found["counts"]:
        totals = (metrics.total_cte_m, metrics.mean_cte_m, metrics.max_cte_m, metrics.off_track)
        found |= zip(_TOTALS, (*totals, metrics.time_to_leaving_s), strict=True)
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


def _without_poses(bag: Path, span: DriveSpan, horizon: Horizon, gap: PoseGapError) -> dict[str, Any]:
    """A drive that does not count, because poses are missing at its control ticks."""
    gap_s = (gap.after_ns - gap.before_ns) / NS_PER_S
    return {
        "attack_ids": sorted(attack_ids(bag, SHOWN_BY, span.start_real_ns, span.end_real_ns)),
        "states": [],
        "stopped_early": _why_silent(
            bag, _CAR, gap.before_ns, gap.after_ns, f"the car was not tracked for {gap_s:.1f} s"
        ),
        "counts": False,
        "driven_ticks": horizon.whole_ticks((gap.before_ns - span.start_real_ns) / NS_PER_S),
        "cte_m": [],
        **dict.fromkeys(_TOTALS),
    }


def _why_silent(bag: Path, topic: str, before_ns: int, after_ns: int, silent: str) -> str:
    """Whether a topic was silent between two of its messages, as ``silent`` says, or the recorder received none of the topics of its host."""
    gap_s, edge_ns = (after_ns - before_ns) / NS_PER_S, round(_EDGE_S * NS_PER_S)
    within = range(before_ns + edge_ns, after_ns - edge_ns)
    relayed = _relayed(bag)
    heard = read_messages(bag, relayed, as_recorded=True)
    if topic not in relayed or any(each.log_ns in within for each in heard):
        return silent
    return f"the recorder received nothing from the other host for {gap_s:.1f} s"


def _relayed(bag: Path) -> tuple[str, ...]:
    """Topics that the recorder's host had from another one, by the launch file attached to a bag; none without it."""
    if RESOLVED_NAME not in read_info(bag).attachments:
        return ()
    source = f"{bag}:{RESOLVED_NAME}"
    text = decode_text(read_attachment(bag, RESOLVED_NAME), source)
    recorded = {topic.name for topic in read_info(bag).topics}
    return tuple(name for name in facts_of(parse_yaml(text, source)).relayed if name in recorded)


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
        stopped = span.reason if early else ""
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


class _Arming(NamedTuple):
    """From an armed state to the disarming; None if the bag ends first. ``is_seen``: a state before it says that the car was not armed."""

    since_ns: int
    until_ns: int | None
    reason: str
    is_seen: bool


def _armings(bag: Path, end_ns: int) -> list[_Arming]:
    """When the car was armed [ns, CLOCK_REALTIME], and why it was disarmed; ``end_ns`` is the stamp of the last pose."""
    found: list[_Arming] = []
    since_ns: int | None = None
    disarmed = False
    for at_ns, armed, reason in _safety_states(bag, end_ns):
        if armed and since_ns is None:
            since_ns = at_ns
        elif not armed:
            if since_ns is not None:
                found.append(_Arming(since_ns, at_ns, reason, disarmed))
            since_ns, disarmed = None, True
    return found if since_ns is None else [*found, _Arming(since_ns, None, "", disarmed)]


def _safety_states(bag: Path, end_ns: int) -> Iterator[tuple[int, bool, str]]:
    """Time [ns, CLOCK_REALTIME], whether armed, and why not, of each report of the safety node.

    A car whose safety node falls silent is disarmed then, as its motor node brakes, until the node reports a disarmed car.
    """
    armed_ns: int | None = None
    lost = False
    for state in read_decoded(bag, _SAFETY):
        at_ns, armed = stamp_ns(state), bool(state.armed)
        if armed_ns is not None and (silence := safety_silence(armed_ns, at_ns)):
            yield _silent(bag, armed_ns, at_ns, silence)
            lost = True
        lost = lost and armed
        if not lost:
            yield at_ns, armed, str(state.reason)
        armed_ns = at_ns if armed and not lost else None
    if armed_ns is not None and (silence := safety_silence(armed_ns, end_ns)):
        yield _silent(bag, armed_ns, end_ns, silence)


def _silent(bag: Path, armed_ns: int, heard_ns: int, silence: str) -> tuple[int, bool, str]:
    why = _why_silent(bag, _SAFETY, armed_ns, heard_ns, silence)
    return armed_ns + round(SAFETY_SILENT_S * NS_PER_S), False, why


def _made_to_let_go(bag: Path) -> list[tuple[int, str]]:
    """Times [ns, CLOCK_REALTIME] at which the operator page took a held button for released, and why."""
    if _ACTS not in {topic.name for topic in read_info(bag).topics}:
        return []
    return [(stamp_ns(each), str(each.detail)) for each in read_decoded(bag, _ACTS) if each.act == _LET_GO]


def _why_disarmed(reason: str, disarmed_ns: int, let_go: Sequence[tuple[int, str]]) -> str:
    """The page's reason for a button that is not held: a person who lets go is a result, a page that does not answer is none."""
    near = [why for at_ns, why in let_go if abs(at_ns - disarmed_ns) <= _TOGETHER_S * NS_PER_S]
    return near[-1] if near and reason.startswith(NOT_HELD) else reason


def _positions(bag: Path) -> tuple[Array, Array]:
    rows = {stamp_ns(pose): pose_matrix(pose)[:2, 3] for pose in read_decoded(bag, _CAR)}
    stamps = sorted(rows)
    return np.array(stamps, np.int64), np.array([rows[stamp] for stamp in stamps])
