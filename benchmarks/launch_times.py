"""From the command to a driving car, and from Ctrl-C to nothing left: ``python -m benchmarks.launch_times`` (about a minute).

The simulated lab runs beside the launch, as a real car would; the policy is the one that drives straight on, so that no time of
torch is in it. A person arms as soon as the graph lets her.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

from benchmarks.results import record_row
from tests.support.live.graph import VICTIMS, Graph, live_graph

COMMAND = "python -m benchmarks.launch_times"
START_LIMIT_S, STOP_LIMIT_S = 5.0, 2.0
SETTINGS = ("record=true", "policy.module=tests.support.live.straight_policy")
NODES = (*VICTIMS, "recorder")


def drive_after_launch(graph: Graph) -> float:
    """Seconds from starting the command until the controller read the first command to move."""
    operator, offset = graph.operator, graph.wire_size()
    operator.seen.clear()
    shutil.rmtree(graph.folder / "bag", ignore_errors=True)  # a recorder does not write over a bag
    began_ns = time.monotonic_ns()
    graph.supervisor = graph.launch()
    while True:
        operator.say_arm()
        operator.watch(0.05)
        moves = [
            row[0] for row in graph.wire(offset) if row[0].name == "SET_RPM" and row[0].mono_ns > began_ns
        ]
        if moves:
            return (moves[0].mono_ns - began_ns) / 1e9
        if time.monotonic_ns() - began_ns > 90e9:
            raise TimeoutError(f"not driving after 90 s: {operator.describe()}")


def stop_after_ctrl_c(graph: Graph) -> tuple[float, int]:
    """Seconds from SIGINT to the end of the supervisor and of every node, with the car at rest; and how many stayed behind."""
    children = _children(graph.supervisor)
    graph.operator.watch(1.0)
    began = time.monotonic()
    graph.supervisor.send_signal(signal.SIGINT)
    graph.supervisor.wait(30.0)
    took_s = time.monotonic() - began
    left = [pid for pid in children if Path(f"/proc/{pid}").exists()]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    if graph.wire(0)[-1][1] != 0.0:
        raise RuntimeError("the launch ended and the car still rolls")
    return took_s, len(left)


def _children(process: subprocess.Popen[bytes]) -> list[int]:
    return [
        int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ] or [
        int(pid)
        for task in Path(f"/proc/{process.pid}/task").iterdir()
        for pid in (task / "children").read_text().split()
    ]


def main() -> None:
    """Measure some times, and record the slowest."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--trial", action="store_true", help="nothing is recorded")
    options = parser.parse_args()
    with live_graph(SETTINGS) as graph:
        graph.ready()
        starts, stops, orphans = [], [], 0
        stop_after_ctrl_c(graph)  # the first start read every file from the disk
        for _ in range(options.times):
            graph.put_back()
            starts.append(drive_after_launch(graph))
            took_s, left = stop_after_ctrl_c(graph)
            stops.append(took_s)
            orphans += left
            print(
                f"driving after {starts[-1]:.2f} s, stopped after {took_s:.2f} s, {left} processes left",
                flush=True,
            )
    if options.trial:
        return
    record_row(
        "launch to driving",
        round(max(starts), 2),
        "s",
        f"<= {START_LIMIT_S:g} s",
        max(starts) <= START_LIMIT_S,
        COMMAND,
        f"slowest of {len(starts)}; the car stands ready, a policy without torch, a recorder",
    )
    record_row(
        "Ctrl-C to all stopped",
        round(max(stops), 2),
        "s",
        f"<= {STOP_LIMIT_S:g} s, no orphan",
        max(stops) <= STOP_LIMIT_S and orphans == 0,
        COMMAND,
        f"slowest of {len(stops)}; {orphans} processes left",
    )


if __name__ == "__main__":
    main()
