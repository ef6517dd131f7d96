"""What stops the car when a part of the live stack dies? About three minutes in full, real time.

Each fault happens to the launch file of the green-screen experiment on the simulated lab, while the car drives at 0.8 m/s. What
counts is what the motor controller reads at its end of the wire: the time to the first brake command, zero current in the end,
and no command to move in between or afterwards. When the motor node or the whole supervisor is killed only the controller's own
time-out is left: the stopping distance is measured with the settings as delivered and with those of the launch file.
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from hardware.emulators.vesc_firmware import WireEvent
from tests.campaigns.campaign import Campaign
from tests.support.live.graph import CONFIGURED, NODES, BrokenPromise, live_graph
from tests.support.live.operator import LiveOperator
from tests.support.spoiled import Spoiled, unspoiled

DRIVE_S, WATCH_S = 1.2, 3.0
BRAKE_LIMIT_MS = 350.0
STOCK = {"timeout_ms": 1000.0, "timeout_brake_current_a": 0.0}
CONTROLLERS = {"as delivered: 1000 ms, 0 A": STOCK, "as configured: 250 ms, 20 A": CONFIGURED}
SOFTWARE = [
    (victim, number)
    for victim in ("camera", "vicon", "compositor", "policy", "safety")
    for number in (signal.SIGKILL, signal.SIGSTOP)
]


@dataclass(frozen=True)
class Stop:
    """How the car stopped after a fault.

    Attributes:
        brake_ms: From the fault to the first brake command or time-out at the controller [ms].
        distance_m: From the fault to standstill [m].
    """

    brake_ms: float
    distance_m: float


def stop_after(victim: str, number: signal.Signals, controller: dict[str, float]) -> Stop:
    """Drive, send a signal to one node (or to ``supervisor``), and see how the car stops."""
    settings = (
        "record=false",
        "policy.module=tests.support.live.straight_policy",
        f"motor.controller_timeout_ms={controller['timeout_ms']:.0f}",
        f"motor.controller_brake_current_a={controller['timeout_brake_current_a']}",
    )
    with live_graph(settings, controller) as graph:
        operator, supervisor = graph.operator, graph.supervisor
        graph.ready()
        operator.arm()
        operator.watch(DRIVE_S)
        if not operator.armed:  # nothing would be seen of the fault
            raise Spoiled(operator.seen["/safety/state"].reason)
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


@pytest.mark.campaign
def test_the_car_brakes_when_a_node_before_the_motor_dies_or_hangs(campaign: Campaign) -> None:
    worst: dict[str, float] = {}
    for victim, number in SOFTWARE[: campaign.size(2, len(SOFTWARE))]:
        stop = unspoiled(partial(stop_after, victim, number, CONFIGURED))
        worst[f"{victim} {number.name}"] = stop.brake_ms
        print(
            f"{victim} {number.name}: brake after {stop.brake_ms:.0f} ms, {stop.distance_m:.2f} m", flush=True
        )
    slowest = max(worst, key=lambda key: worst[key])
    campaign.record(
        "brake at the controller after kill -9 or SIGSTOP of camera, vicon, compositor, policy, safety",
        round(worst[slowest]),
        "ms",
        f"<= {BRAKE_LIMIT_MS:g} ms, then zero, no motion until armed again",
        worst[slowest] <= BRAKE_LIMIT_MS,
        f"slowest of {len(worst)}: {slowest}; then zero current and no command to move, also after SIGCONT",
    )
    assert worst[slowest] <= BRAKE_LIMIT_MS


@pytest.mark.campaign
@pytest.mark.parametrize("victim", ["motor", "supervisor"])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_the_controllers_own_time_out_stops_the_car(campaign: Campaign, controller: str, victim: str) -> None:
    stop = unspoiled(partial(stop_after, victim, signal.SIGKILL, CONTROLLERS[controller]))
    campaign.record(
        f"stopping distance after kill -9 of {victim}, controller {controller}",
        round(stop.distance_m, 2),
        "m",
        "the controller's time-out stops the car, no process left",
        True,
        f"time-out {stop.brake_ms:.0f} ms after the kill, at 0.8 m/s",
    )
