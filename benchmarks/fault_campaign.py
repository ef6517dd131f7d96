"""Does the car stop, whatever happens? ``python -m benchmarks.fault_campaign`` (200 faults, about 40 minutes, real time; resumes).

Random faults at random moments while the green-screen graph drives the simulated car at 0.8 m/s: every node killed and stopped, the
supervisor killed, the camera frozen, VICON lost in each of its forms, measured in two places,
a car that is held fast, serial garbage, an unplugged controller, a policy that
floods the bus or sends what is no number. Nodes that die are started again, so that what must not happen can happen: a successor,
or a node that wakes up, moving the car. What counts is what the motor controller reads at its end of the wire. Every finished
fault is a file in ``runs/fault_campaign``; a campaign that was interrupted goes on with the next one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.geometry import planar_pose
from benchmarks.fault_stops import CONFIGURED, LAUNCH_FILE, NODES, BrokenPromise
from benchmarks.operator import LiveOperator
from benchmarks.processes import end
from benchmarks.results import REPOSITORY, record_row
from hardware.emulators.vesc_emulator import read_wire_log
from nodes.runtime.messages import pose_message

COMMAND = "python -m benchmarks.fault_campaign"
FOLDER = REPOSITORY / "runs" / "fault_campaign"
VICTIMS = ("camera", "vicon", "compositor", "policy", "safety", "motor")
FAULTS = (
    *(f"kill {name}" for name in (*VICTIMS, "supervisor")),
    *(f"hang {name}" for name in VICTIMS),
    *("camera silent", "camera repeated", "vicon missing", "vicon zeros", "vicon nan", "vicon frozen"),
    *("vicon two_senders", "vicon jump", "car jammed"),
    *("wire garbage", "wire bad_crc", "wire silent", "usb unplug", "policy flood", "policy nan"),
)
START = (-1.1, -2.0, 0.0)
SEED, COUNT, LIMIT_MS = 20261121, 200, 350.0
STOP_S, AFTER_S = 1.6, 1.2
VICON_PORT = 51087
# What is seen only in what does not happen: the car must be at rest for a second before it counts as stalled.
SLOW_LIMITS_MS = {"car jammed": 1400.0}
_STOPS = ("SET_CURRENT_BRAKE", "TIMEOUT")
_RULE = "{max_restarts: 1000, delay_s: 0.2, max_delay_s: 0.2}"
_RESPAWNING = (
    "record=false",
    "policy.module=benchmarks.mad_policy",
    *(f"{name}.required=false" for name in VICTIMS),
    *(f"{name}.respawn={_RULE}" for name in VICTIMS),
)


def plan(count: int, seed: int = SEED) -> list[tuple[str, float]]:
    """Faults in random order, every kind about equally often, each with the time driven before it [s]; more of them begin alike."""
    order, moments = random.Random(seed), random.Random(f"moments of {seed}")
    faults: list[str] = []
    while len(faults) < count:
        faults += order.sample(FAULTS, len(FAULTS))
    return [(fault, moments.uniform(0.6, 1.6)) for fault in faults[:count]]


class NotDriven(BrokenPromise):
    """The car was stopped before its fault, which therefore says nothing."""


class Graph:
    """The simulated lab in a process of its own, and beside it the launch, which is started again when it was killed.

    Args:
        folder: Run folder.
        settings: Overrides of the launch file; None lets nodes that die come back, with a policy that can go mad.
    """

    def __init__(self, folder: Path, settings: Sequence[str] | None = None) -> None:
        self.folder = folder
        self.settings = _RESPAWNING if settings is None else tuple(settings)
        config = folder / "twin.yaml"
        config.write_text(json.dumps({"vesc": CONFIGURED, "vicon": {"port": VICON_PORT}}), encoding="utf-8")
        self.log = (folder / "campaign.log").open("ab")
        arguments = ("--name", "twin", "--config", str(config), "--folder", str(folder))
        self.twin = self._start(
            "benchmarks.faulty_twin", *arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.operator = LiveOperator(folder, NODES)
        self.supervisor = self.launch()

    def launch(self) -> subprocess.Popen[bytes]:
        """Start the launch; its process."""
        settings = ("twin.if=false", f"params.vicon_port={VICON_PORT}", *self.settings)
        overrides = [part for setting in settings for part in ("--set", setting)]
        return self._start("nodes.cli", "launch", str(LAUNCH_FILE), "--folder", str(self.folder), *overrides)

    def _start(
        self, module: str, *arguments: str, stdin: int | None = None, stdout: Any = None
    ) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", module, *arguments]
        return subprocess.Popen(
            command, cwd=REPOSITORY, stdin=stdin, stdout=stdout or self.log, stderr=self.log
        )

    def twin_says(self, line: str) -> None:
        """Have the lab do something; returns when it was done."""
        assert self.twin.stdin is not None
        assert self.twin.stdout is not None
        self.twin.stdin.write(line.encode() + b"\n")
        self.twin.stdin.flush()
        if self.twin.stdout.readline() != b"ok\n":
            raise BrokenPromise(f"the lab did not obey {line!r}: see {self.log.name}")

    def ready(self) -> None:
        """All nodes up; the launch is started if it is not running."""
        if self.supervisor.poll() is not None:
            self.operator.seen.clear()
            self.supervisor = self.launch()
        self.operator.wait_ready()

    def put_back(self, start: tuple[float, float, float] = START) -> None:
        """Lift the car to a start pose (x [m], y [m], yaw [rad]), once it stands."""
        offset, operator = self.wire_size(), self.operator

        def placed() -> bool:
            # Stamped anew each time: the twin refuses an old request.
            operator.bus.publish("/twin/reset", pose_message(planar_pose(*start), time.time_ns()))
            operator.watch(0.2)
            return any(row[0].name == "PLACED" for row in self.wire(offset))

        operator.wait_until(placed, 60.0, "to put the car back")

    def wire_size(self) -> int:
        """Length of the wire's log [bytes]."""
        return (self.folder / "vesc_wire.csv").stat().st_size

    def wire(self, offset: int) -> list[Any]:
        """What the controller read since the log was so long."""
        return read_wire_log(self.folder / "vesc_wire.csv", offset)

    def close(self) -> None:
        """End everything."""
        self.operator.bus.close()
        for process in (self.supervisor, self.twin):
            end(process)
        self.log.close()


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
    """Drive, break something, mend it, and tell what the controller read meanwhile."""
    graph.ready()
    graph.put_back()
    operator, offset = graph.operator, graph.wire_size()
    operator.arm()
    operator.watch(drive_s)
    rows = graph.wire(offset)
    if not operator.armed or rows[-1][1] < 0.2:
        raise NotDriven(f"{fault}: the car did not drive before the fault: {operator.describe()}")
    fault_ns, heal = cause(graph, fault)
    operator.watch(STOP_S)
    heal()
    operator.watch(AFTER_S)
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
            f"{fault}: {what} after it until {STOP_S + AFTER_S:g} s later; it read {[r[0] for r in later[-5:]]}"
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


def run(folder: Path, count: int) -> list[dict[str, Any]]:
    """Every fault that is not there yet; a fault that broke the promise is kept too, and the graph begins anew."""
    folder.mkdir(parents=True, exist_ok=True)
    graph: Graph | None = None
    try:
        for number, (fault, drive_s) in enumerate(plan(count)):
            file = folder / f"{number:03d}.json"
            if file.exists() and read_json(file)["fault"] == fault:
                continue  # done; a file of another plan is not
            if graph is None:
                graph = Graph(Path(tempfile.mkdtemp(prefix="advnerf-")))
            try:
                result = suffer(graph, fault, drive_s)
                print(
                    f"{number:3d} {fault:16s} {result['by']:18s} {result['stop_ms']:5.0f} ms  {result['distance_m']:.2f} m",
                    flush=True,
                )
            except (BrokenPromise, TimeoutError) as error:
                result = {"fault": fault, "broken": str(error)}
                print(f"{number:3d} {fault:16s} BROKEN: {error} (log: {graph.log.name})", flush=True)
                graph.close()
                graph = None
            write_atomically(file, json.dumps(result))
    finally:
        if graph is not None:
            graph.close()
    return [read_json(folder / f"{number:03d}.json") for number in range(count)]


def report(results: list[dict[str, Any]], record: bool) -> None:
    """Print the worst, and write the rows."""
    broken = [r for r in results if "broken" in r]
    good = [r for r in results if "broken" not in r]
    longest = max(good, key=lambda r: r["distance_m"])
    slowest = max((r for r in good if r["fault"] not in SLOW_LIMITS_MS), key=lambda r: r["stop_ms"])
    print(f"stopped in {len(good)} of {len(results)}; slowest {slowest}; longest {longest}; broken: {broken}")
    if not record:
        return
    record_row(
        f"fault campaign: stopped and stayed stopped, of {len(results)} random faults",
        len(good),
        f"of {len(results)}",
        f"{len(results)}",
        not broken,
        COMMAND,
        "; ".join(r["broken"] for r in broken)[:300] or f"{len(FAULTS)} kinds of fault",
    )
    record_row(
        "fault campaign: worst time from fault to brake at the controller",
        round(slowest["stop_ms"]),
        "ms",
        f"<= {LIMIT_MS:g} ms",
        slowest["stop_ms"] <= LIMIT_MS,
        COMMAND,
        f"{slowest['fault']}, by {slowest['by']}; without {', '.join(SLOW_LIMITS_MS)}",
    )
    for fault, limit_ms in SLOW_LIMITS_MS.items():
        if times := [r["stop_ms"] for r in good if r["fault"] == fault]:
            record_row(
                f"fault campaign: worst time from '{fault}' to brake at the controller",
                round(max(times)),
                "ms",
                f"<= {limit_ms:g} ms",
                max(times) <= limit_ms,
                COMMAND,
                f"of {len(times)}; a stall is a second without motion",
            )
    record_row(
        "fault campaign: worst stopping distance at 0.8 m/s",
        round(longest["distance_m"], 2),
        "m",
        "-",
        None,
        COMMAND,
        f"{longest['fault']}, by {longest['by']}",
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--trial", action="store_true", help="in a folder of its own, nothing is recorded")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="campaign-")) if options.trial else FOLDER
    report(run(folder, options.count), record=not options.trial)


if __name__ == "__main__":
    main()
