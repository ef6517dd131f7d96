"""One fault of the graph while its car drives, and what the motor controller read of it at its end of the wire."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

from advnerf_core.files import write_atomically
from tests.support.live.graph import BrokenPromise, Graph
from tests.support.spoiled import Spoiled

_STOP_S, _AFTER_S = 1.6, 1.2
# What is seen only in what does not happen: the car must be at rest for a second before it counts as stalled.
SLOW_LIMITS_MS = {"car jammed": 1400.0}
_STOPS = ("SET_CURRENT_BRAKE", "TIMEOUT")


def cause(graph: Graph, fault: str) -> tuple[int, Any]:
    """Make a fault happen; when [monotonic ns], and what ends it."""
    what, name = fault.split()
    if what in ("kill", "hang"):
        pid = graph.supervisor.pid if name == "supervisor" else graph.operator.pid_of(name)
        before_ns = time.monotonic_ns()
        os.kill(pid, signal.SIGKILL if what == "kill" else signal.SIGSTOP)
        if what == "hang":
            return before_ns, lambda: os.kill(pid, signal.SIGCONT)
        if name == "supervisor":
            graph.supervisor.wait()
        else:
            graph.operator.seen.pop(f"/status/{name}", None)
        return before_ns, lambda: None
    if what == "policy":
        flag = graph.folder / "mad"
        before_ns = time.monotonic_ns()
        write_atomically(flag, name)
        return before_ns, flag.unlink
    before_ns = time.monotonic_ns()
    graph.twin_says(fault)
    return before_ns, lambda: graph.twin_says(f"{what} heal")


def suffer(graph: Graph, fault: str, drive_s: float) -> dict[str, Any]:
    """Drive, break something, mend it, and tell what the controller read meanwhile; `Spoiled` if the car was stopped before that."""
    graph.ready()
    graph.put_back()
    operator, offset = graph.operator, graph.wire_size()
    operator.arm()
    operator.watch(drive_s)
    rows = graph.wire(offset)
    if not operator.armed or rows[-1][1] < 0.2:
        raise Spoiled(f"{fault}: the car did not drive before the fault: {operator.describe()}")
    fault_ns, heal = cause(graph, fault)
    operator.watch(_STOP_S)
    heal()
    operator.watch(_AFTER_S)
    return judge(fault, graph.wire(offset), fault_ns, operator.armed and fault != "kill supervisor")


def judge(fault: str, rows: list[Any], fault_ns: int, armed: bool) -> dict[str, Any]:
    """What a wire's log says about a fault; a `BrokenPromise` if the car was not stopped, or moved again."""
    at_fault = [row for row in rows if row[0].mono_ns <= fault_ns][-1]
    later = [row for row in rows if row[0].mono_ns > fault_ns]
    stop = next((row[0] for row in later if row[0].name in _STOPS), None)
    standing = next((row for row in later if row[0].name == "STANDSTILL"), None)
    if stop is None or standing is None:
        what = "no brake" if stop is None else "no standstill"
        raise BrokenPromise(
            f"{fault}: {what} after it until {_STOP_S + _AFTER_S:g} s later; it read {[r[0] for r in later[-5:]]}"
        )
    moves = [row for row in later if row[0].mono_ns > stop.mono_ns and row[0].name in ("SET_RPM", "MOVING")]
    if moves or armed:
        raise BrokenPromise(f"{fault}: armed {armed}, {len(moves)} commands to move after it was stopped")
    rolled = at_fault[2] + at_fault[1] * (fault_ns - at_fault[0].mono_ns) / 1e9
    return {
        "fault": fault,
        "by": stop.name,
        "stop_ms": (stop.mono_ns - fault_ns) / 1e6,
        "distance_m": standing[2] - rolled,
        "speed_mps": at_fault[1],
    }
