"""Whether load or a fault of the node graph spoiled a drive. Decided from the health of nodes and from timing alone.

The rule is the same for every condition and reads no position of the car, so that it cannot select drives by their outcome.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nodes.bags.decoded import read_decoded
from nodes.bags.reader import read_info
from nodes.control.stop_causes import is_result
from nodes.lab.trials.evaluation import SENT, command_ages_ns
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import ns_from_stamp
from nodes.runtime.topics import STATUS_PREFIX

# Share of control ticks that may have no new command, or a late one.
_TICK_SHARE = 0.1
# Time from the capture of an image to its command beyond which the command is late [s]. It is two control periods.
_LATE_S = 0.2
# Share of its own ticks that a node's loop may miss.
_LOOP_SHARE = 0.25
# Counter of the node twin.
_MISSED_PICTURES = "missed camera"


@dataclass(frozen=True)
class DriveHealth:
    """Health of the node graph during one drive.

    Attributes:
        stopped: Why the safety node disarmed; empty for a complete drive.
        ticks: Control ticks of the drive.
        unserved: Control ticks without a new command at the motor.
        late: Commands that were late.
        loops: Share of ticks that the loop of each node missed.
        commands: Commands of the drive, as many as its images; None counts one for each tick.
        pictures: Pictures that a simulated camera skipped, because it was still drawing an earlier one; up to the end of the bag.
    """

    stopped: str
    ticks: int
    unserved: int = 0
    late: int = 0
    loops: Mapping[str, float] = field(default_factory=dict)
    pictures: int = 0
    commands: int | None = None


def spoiled_by(health: DriveHealth) -> str:
    """Return why a drive measures nothing; empty if it counts."""
    if not is_result(health.stopped):
        return f"the stack stopped the car: {health.stopped}{_slow_camera(health.pictures)}"
    most = max(1, int(_TICK_SHARE * health.ticks))
    if health.unserved > most:
        return f"{health.unserved} of {health.ticks} control ticks had no new command; at most {most} may"
    commands = health.ticks if health.commands is None else health.commands
    if health.late > (most := max(1, int(_TICK_SHARE * commands))):
        return f"{health.late} of {commands} commands were older than {_LATE_S:g} s; at most {most} may"
    for node, share in sorted(health.loops.items()):
        if share > _LOOP_SHARE:
            return f"node {node} missed {100 * share:.0f} % of its ticks; at most {100 * _LOOP_SHARE:.0f} % may be missed"
    return ""


def _slow_camera(pictures: int) -> str:
    """Return why a simulated camera may have stopped the car; empty if it skipped none."""
    if not pictures:
        return ""
    return (
        f"; the simulated camera skipped {pictures} of its pictures: this machine is too slow for it, or something else runs beside it "
        "(a camera with exposure draws its `moments` pictures for each frame: fewer are cheaper)"
    )


def read_health(
    bag: Path,
    start_real_ns: int,
    end_real_ns: int,
    stopped: str,
    tick_s: float,
) -> DriveHealth:
    """Read the health of a drive between two times [ns, CLOCK_REALTIME] from its bag."""
    # An image that was captured less than a tick before the end may find the car disarmed.
    last_ns = end_real_ns - round(tick_s * NS_PER_S)
    ticks = max(0, int((last_ns - start_real_ns) / NS_PER_S / tick_s + 1e-6))
    recorded = {topic.name for topic in read_info(bag).topics}
    ages_ns = command_ages_ns(bag) if SENT in recorded else {}
    served = sorted(at for at in ages_ns if start_real_ns <= at < last_ns)
    ages_s = np.array([ages_ns[at] / NS_PER_S for at in served])
    reports = {
        name.removeprefix(STATUS_PREFIX): _counters(bag, name, start_real_ns)
        for name in sorted(recorded)
        if name.startswith(STATUS_PREFIX)
    }
    loops = {
        node: share
        for node, counters in reports.items()
        if (share := _missed_share([values for at_ns, values in counters if at_ns <= end_real_ns]))
        is not None
    }
    # Also after the end: a picture that comes so late that the car is stopped is counted when it has come.
    pictures = sum(
        int(_rise([values for _, values in counters], _MISSED_PICTURES)) for counters in reports.values()
    )
    late = int(np.count_nonzero(ages_s > _LATE_S))
    unserved = _unserved(served, start_real_ns, last_ns, round(tick_s * NS_PER_S))
    return DriveHealth(stopped, ticks, min(ticks, unserved), late, loops, pictures, len(served))


def _unserved(served_ns: Sequence[int], start_ns: int, end_ns: int, tick_ns: int) -> int:
    """Ticks without a new command, from the gaps between the images that became one: a faster camera does not make up for a pause."""
    if not served_ns:
        return (end_ns - start_ns) // tick_ns
    gaps = np.diff(served_ns)
    edges = (served_ns[0] - start_ns) // tick_ns + (end_ns - 1 - served_ns[-1]) // tick_ns
    return int(edges + np.maximum(np.rint(gaps / tick_ns) - 1.0, 0.0).sum())


def _counters(bag: Path, topic: str, start_ns: int) -> list[tuple[int, dict[str, float]]]:
    """The times [ns] and counters of a node's reports from the start of a drive to the end of its bag."""
    return [
        (at_ns, dict(zip(message.counter_names, map(float, message.counter_values), strict=True)))
        for message in read_decoded(bag, topic)
        if (at_ns := ns_from_stamp(message.header.stamp)) >= start_ns
    ]


def _rise(reports: Sequence[Mapping[str, float]], name: str) -> float:
    """How far a counter rose from the first to the last report; 0 for a counter that the node does not have."""
    counts = [values[name] for values in reports if name in values]
    return counts[-1] - counts[0] if counts else 0.0


def _missed_share(reports: Sequence[Mapping[str, float]]) -> float | None:
    """Share of its ticks that a node's loop missed; None for a node without ticks, or without two reports."""
    done, missed = _rise(reports, "ticks"), _rise(reports, "ticks_missed")
    return missed / (done + missed) if done + missed > 0 else None
