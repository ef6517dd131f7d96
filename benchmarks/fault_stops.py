"""What stops the car when a part of the live stack dies? ``python -m benchmarks.fault_stops`` (about three minutes, real time).

Each fault happens to the launch file of the green-screen experiment on the simulated lab, while the car drives at 0.8 m/s. What
counts is what the motor controller reads at its end of the wire: the time to the first brake command, zero current in the end,
and no command to move in between or afterwards. When the motor node or the whole supervisor is killed only the controller's own
time-out is left: the stopping distance is measured with the settings as delivered and with those of the launch file.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.operator import LiveOperator
from benchmarks.processes import end
from benchmarks.results import REPOSITORY, record_row
from hardware.emulators.vesc_firmware import WireEvent

COMMAND = "python -m benchmarks.fault_stops"
LAUNCH_FILE = REPOSITORY / "launch" / "green_screen.launch.yaml"
NODES = ("twin", "camera", "vicon", "compositor", "policy", "safety", "motor")
VICTIMS = ("camera", "vicon", "compositor", "policy", "safety")
DRIVE_S, WATCH_S = 1.2, 3.0
BRAKE_LIMIT_MS = 350.0
STOCK = {"timeout_ms": 1000.0, "timeout_brake_current_a": 0.0}
CONFIGURED = {"timeout_ms": 250.0, "timeout_brake_current_a": 20.0}
# Not the default, so that it does not meet a lab that is running.
VICON_PORT = 51077


class BrokenPromise(RuntimeError):
    """The car moved when it should not have, or processes stayed behind."""


@dataclass(frozen=True)
class Stop:
    """How the car stopped after a fault.

    Attributes:
        brake_ms: From the fault to the first brake command or time-out at the controller [ms].
        distance_m: From the fault to standstill [m].
    """

    brake_ms: float
    distance_m: float


@contextmanager
def live_graph(controller: dict[str, float]) -> Iterator[tuple[LiveOperator, subprocess.Popen[bytes]]]:
    """The launch file at work with a car that stands ready, and its supervisor's process.

    The twin is started beside the launch and not by it: like a real car it does not vanish with the software.
    """
    with tempfile.TemporaryDirectory(prefix="advnerf-") as folder:
        config = Path(folder) / "twin.yaml"
        config.write_text(json.dumps({"vesc": controller, "vicon": {"port": VICON_PORT}}), encoding="utf-8")
        twin = _start("nodes.twin", "--config", str(config), "--folder", folder)
        settings = (
            "record=false",
            "twin.if=false",
            f"params.vicon_port={VICON_PORT}",
            "policy.module=benchmarks.straight_policy",
            f"motor.controller_timeout_ms={controller['timeout_ms']:.0f}",
            f"motor.controller_brake_current_a={controller['timeout_brake_current_a']}",
        )
        overrides = [part for setting in settings for part in ("--set", setting)]
        supervisor = _start("nodes.cli", "launch", str(LAUNCH_FILE), "--folder", folder, *overrides)
        operator = LiveOperator(Path(folder), NODES)
        try:
            operator.wait_ready(timeout_s=90.0)
            yield operator, supervisor
        finally:
            operator.bus.close()
            for process in (supervisor, twin):
                end(process)


def _start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def stop_after(victim: str, number: signal.Signals, controller: dict[str, float]) -> Stop:
    """Drive, send a signal to one node (or to ``supervisor``), and see how the car stops."""
    with live_graph(controller) as (operator, supervisor):
        operator.arm()
        operator.watch(DRIVE_S)
        pids = [operator.pid_of(node) for node in NODES if node != "twin"]
        pid = supervisor.pid if victim == "supervisor" else operator.pid_of(victim)
        fault_ns = time.monotonic_ns()
        os.kill(pid, number)
        operator.watch(WATCH_S)
        if number == signal.SIGSTOP:
            os.kill(pid, signal.SIGCONT)
            operator.watch(1.0)
        stop = _stop_on_the_wire(operator, victim, fault_ns)
        if victim == "supervisor":
            supervisor.wait(5.0)
            _require_gone(pids)
        return stop


def _stop_on_the_wire(operator: LiveOperator, victim: str, fault_ns: int) -> Stop:
    rows = operator.wire()
    at_fault = [row for row in rows if row[0].mono_ns <= fault_ns][-1]
    distance_at_fault = at_fault[2] + at_fault[1] * (fault_ns - at_fault[0].mono_ns) / 1e9
    later = [row for row in rows if row[0].mono_ns > fault_ns]
    standing = next((row for row in later if row[0].name == "STANDSTILL"), rows[-1])
    events = operator.commands_after(fault_ns)
    stop = next((e for e in events if e.name in ("SET_CURRENT_BRAKE", "TIMEOUT")), None)
    if stop is None:
        raise BrokenPromise(
            f"{victim}: nothing told the controller to stop within {WATCH_S} s; it read {events[-5:]}"
        )
    _require_rest(victim, [e for e in events if e.mono_ns > stop.mono_ns], stop)
    return Stop((stop.mono_ns - fault_ns) / 1e6, standing[2] - distance_at_fault)


def _require_rest(victim: str, after: list[WireEvent], stop: WireEvent) -> None:
    if moves := [e for e in after if e.name == "SET_RPM"]:
        raise BrokenPromise(f"{victim}: {len(moves)} commands to move came after the car was told to stop")
    if stop.name == "SET_CURRENT_BRAKE" and (after[-1].name, after[-1].value) not in (
        ("SET_CURRENT", 0.0),
        ("TIMEOUT", 20.0),
    ):
        raise BrokenPromise(f"{victim}: expected zero current in the end, the last command was {after[-1]}")


def _require_gone(pids: list[int]) -> None:
    deadline = time.monotonic() + 5.0
    while left := [pid for pid in pids if Path(f"/proc/{pid}").exists()]:
        if time.monotonic() > deadline:
            raise BrokenPromise(f"processes {left} outlived their supervisor")
        time.sleep(0.05)


def measure_software_stops() -> None:
    """Kill and stop every node before the motor."""
    worst: dict[str, float] = {}
    for victim in VICTIMS:
        for number in (signal.SIGKILL, signal.SIGSTOP):
            stop = stop_after(victim, number, CONFIGURED)
            worst[f"{victim} {number.name}"] = stop.brake_ms
            print(
                f"{victim:10s} {number.name}: brake after {stop.brake_ms:5.0f} ms, {stop.distance_m:.2f} m to standstill"
            )
    slowest = max(worst, key=lambda key: worst[key])
    record_row(
        "brake at the controller after kill -9 or SIGSTOP of camera, vicon, compositor, policy, safety",
        round(worst[slowest]),
        "ms",
        f"<= {BRAKE_LIMIT_MS:g} ms, then zero, no motion until armed again",
        worst[slowest] <= BRAKE_LIMIT_MS,
        COMMAND,
        f"slowest of {len(worst)}: {slowest}; then zero current and no command to move, also after SIGCONT",
    )


def measure_last_line() -> None:
    """Kill the motor node and the supervisor, with the controller as delivered and as configured."""
    for name, controller in (
        ("as delivered: 1000 ms, 0 A", STOCK),
        ("as configured: 250 ms, 20 A", CONFIGURED),
    ):
        for victim in ("motor", "supervisor"):
            stop = stop_after(victim, signal.SIGKILL, controller)
            print(
                f"{victim:10s} SIGKILL, controller {name}: {stop.brake_ms:.0f} ms, {stop.distance_m:.2f} m to standstill"
            )
            record_row(
                f"stopping distance after kill -9 of {victim}, controller {name}",
                round(stop.distance_m, 2),
                "m",
                "the controller's time-out stops the car, no process left",
                True,
                COMMAND,
                f"time-out {stop.brake_ms:.0f} ms after the kill, at 0.8 m/s",
            )


if __name__ == "__main__":
    measure_software_stops()
    measure_last_line()
