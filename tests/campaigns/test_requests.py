"""Do requests to arm and to disarm arrive, and how soon? 1,000 pairs in full, about ten minutes.

The green-screen graph drives the simulated car, with a recorder, the viewer and one core kept busy. Each request is that of a
command: it opens a bus of its own, so that its topic has no subscriber yet, and closes it afterwards. A request is lost if the
safety node does not answer it, or if the motor controller does not read what was asked for: a command to move, or the brake.
"""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest

from benchmarks.repeat_tests import endless_loop
from hardware.emulators.vesc_firmware import WireEvent
from nodes.runtime.arm_requests import ask_to_arm
from nodes.runtime.errors import LaunchError
from tests.campaigns.campaign import Campaign
from tests.support.disarm import ask_to_disarm
from tests.support.live.graph import START, Graph, live_graph
from tests.support.live.processes import REPOSITORY, end

SEED, BRAKE_LIMIT_MS, RETURN_LIMIT_MS = 20261122, 300.0, 300.0
SETTINGS = (
    "policy.module=tests.support.live.straight_policy",
    "record.topics=[/arm, /safety/state, /safety/drive, /motor/sent, /vicon/car]",
)
_TURN_BACK_X_M = 1.5
_WIRE_S = 1.0
_GIVE_UP_S = 10.0
# A node says within this time that it is in fault, and the safety node that it has stopped the car.
_STATUS_S = 1.0


@dataclass
class Tally:
    """What became of the requests.

    Attributes:
        pairs: Arms and disarms that had their effect.
        lost: Requests without an answer or without their effect on the wire, in words.
        refused: Answers that gave a reason why the car was not armed.
        stopped: Drives that the safety node ended before the request to disarm.
        brake_ms: From each request to disarm to the first brake command at the controller [ms].
        return_ms: From there to the return of the request [ms].
    """

    pairs: int = 0
    lost: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    stopped: list[str] = field(default_factory=list)
    brake_ms: list[float] = field(default_factory=list)
    return_ms: list[float] = field(default_factory=list)


@contextmanager
def busy_lab() -> Iterator[Graph]:
    """The graph with a recorder, a viewer beside it, and a core that has no time."""
    with live_graph(SETTINGS) as graph:
        arguments = ("-m", "nodes.viewer", "--folder", str(graph.folder), "--set", "port=0")
        others = [
            subprocess.Popen([sys.executable, *words], cwd=REPOSITORY, stdout=graph.log, stderr=graph.log)
            for words in (arguments, endless_loop())
        ]
        try:
            graph.ready()
            yield graph
        finally:
            for other in others:
                end(other)


def run(count: int) -> Tally:
    """So many requests to arm, each followed by one to disarm."""
    tally, moments = Tally(), random.Random(SEED)
    with busy_lab() as graph:
        while tally.pairs + len(tally.lost) < count:
            seen = graph.operator.seen.get("/vicon/car")
            if seen is None or seen.pose.position.x > _TURN_BACK_X_M or not tally.pairs:
                graph.put_back(START)
            _pair(graph, tally, moments.uniform(0.0, 0.1))
            if tally.pairs % 50 == 0:
                print(
                    f"{tally.pairs} pairs, {len(tally.lost)} lost, {len(tally.refused)} refused", flush=True
                )
    return tally


def _pair(graph: Graph, tally: Tally, drive_s: float) -> None:
    offset = graph.wire_size()
    try:
        answer = ask_to_arm(graph.folder, "benchmark")
    except LaunchError as error:
        tally.lost.append(f"arm: {error}")
        return
    if not answer.granted:
        tally.refused.append(answer.text)
        graph.operator.watch(0.2)
        return
    moved = _event(graph, offset, 0, "SET_RPM")
    if moved is None:
        graph.operator.watch(_STATUS_S)
        stopped = not graph.operator.armed or graph.operator.state_of("motor") == "fault"
        (tally.stopped if stopped else tally.lost).append(
            f"armed, but no command to move: {graph.operator.describe()}"
        )
        ask_to_disarm(graph.folder, "benchmark", _patience(time.monotonic_ns()))
        return
    graph.operator.watch(drive_s)
    asked_ns = time.monotonic_ns()
    disarmed = ask_to_disarm(graph.folder, "benchmark", _patience(asked_ns))
    returned_ns = time.monotonic_ns()
    brake = _event(graph, offset, moved.mono_ns, "SET_CURRENT_BRAKE")
    graph.operator.watch(0.05)
    if brake is not None and brake.mono_ns < asked_ns:
        tally.stopped.append("braked before it was asked to")
    elif brake is None or disarmed.armed or not disarmed.braked:
        tally.lost.append(f"disarm: {disarmed}, brake at the controller: {brake}")
    else:
        tally.pairs += 1
        tally.brake_ms.append((brake.mono_ns - asked_ns) / 1e6)
        tally.return_ms.append((returned_ns - brake.mono_ns) / 1e6)


def _patience(asked_ns: int) -> Callable[[float], None]:
    def silent(waited_s: float) -> None:
        print(f"no answer for {waited_s:.1f} s to a disarm of {asked_ns}", flush=True)
        if waited_s > _GIVE_UP_S:
            raise TimeoutError(f"a disarm was not answered within {_GIVE_UP_S:g} s")

    return silent


def _event(graph: Graph, offset: int, since_ns: int, name: str) -> WireEvent | None:
    """The first such event at the controller; None if there is none within a moment."""
    deadline = time.monotonic() + _WIRE_S
    while time.monotonic() < deadline:
        for row in graph.wire(offset):
            event: WireEvent = row[0]
            if event.name == name and event.mono_ns >= since_ns:
                return event
        graph.operator.watch(0.01)
    return None


def report(campaign: Campaign, tally: Tally) -> None:
    """Write the rows."""
    p99_ms, worst_ms = float(np.percentile(tally.brake_ms, 99)), max(tally.brake_ms)
    back_ms = max(tally.return_ms)
    answered = 2 * tally.pairs + len(tally.refused)
    campaign.record(
        f"requests lost, of {tally.pairs} to arm and {tally.pairs} to disarm",
        len(tally.lost),
        "requests",
        "0",
        not tally.lost,
        "; ".join(tally.lost)[:300]
        or f"under a recorder, a viewer and a busy core; {answered} answered, {len(tally.refused)} of them why not armed,"
        f" {len(tally.stopped)} drives stopped by the safety node first",
    )
    campaign.record(
        "disarm to brake at the controller, p99",
        round(p99_ms),
        "ms",
        f"<= {BRAKE_LIMIT_MS:g} ms",
        p99_ms <= BRAKE_LIMIT_MS,
        f"of {len(tally.brake_ms)}; median {np.median(tally.brake_ms):.0f} ms, worst {worst_ms:.0f} ms; from the request,"
        " with a bus opened for it, to the first brake command; the start of the command's process is not in it",
    )
    campaign.record(
        "brake at the controller to the return of the disarm, worst",
        round(back_ms),
        "ms",
        f"<= {RETURN_LIMIT_MS:g} ms",
        back_ms <= RETURN_LIMIT_MS,
        f"of {len(tally.return_ms)}",
    )


@pytest.mark.campaign
def test_no_request_is_lost_or_late(campaign: Campaign) -> None:
    tally = run(campaign.size(20, 1000))
    print(f"refused: {set(tally.refused)}; stopped: {set(tally.stopped)}")
    report(campaign, tally)
    assert tally.lost == []
    assert np.percentile(tally.brake_ms, 99) <= BRAKE_LIMIT_MS
    assert max(tally.return_ms) <= RETURN_LIMIT_MS
