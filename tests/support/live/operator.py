"""The eyes and hands of a person beside a live graph: sees statuses and the wire log, arms and disarms. For benchmarks and tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hardware.emulators.vesc_firmware import WireEvent
from nodes.runtime.arm_requests import arm_message
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.requests import RequestIdentity
from tests.support.wire_log import read_wire_log

_UP = ("ready", "active")
MOTOR_EVENTS = ("SET_RPM", "SET_CURRENT_BRAKE", "SET_CURRENT", "TIMEOUT")


class LiveOperator:
    """Sits on the bus of a run folder.

    Args:
        run_dir: Folder of the run.
        nodes: Nodes that must be up.
    """

    def __init__(self, run_dir: Path, nodes: Sequence[str]) -> None:
        self.run_dir = run_dir
        self.nodes = tuple(nodes)
        self.bus = Bus(run_dir)
        for topic in (
            "/safety/state",
            "/vicon/car",
            "/motor/sent",
            "/motor/state",
            *(f"/status/{n}" for n in self.nodes),
        ):
            self.bus.subscribe(topic)
        self.seen: dict[str, Any] = {}
        self.sent: list[Any] = []

    def watch(self, duration_s: float = 0.0) -> None:
        """Look at what comes for a while."""
        deadline = time.monotonic() + duration_s
        while True:
            self.bus.wait(max(0.0, min(0.02, deadline - time.monotonic())))
            for received in self.bus.receive():
                self.seen[received.topic] = message = received.message()
                self.heard(received.topic, message)
            if time.monotonic() >= deadline:
                return

    def heard(self, topic: str, message: Any) -> None:
        """Note a message; a subclass may look at more."""
        if topic == "/motor/sent":
            self.sent.append(message)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Look until something is so; a `TimeoutError` says what is not."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"gave up after {timeout_s:g} s waiting {what}: {self.describe()}")
            self.check()
            self.watch(0.02)

    def check(self) -> None:
        """Called while waiting; raises if waiting is in vain."""

    def describe(self) -> str:
        """What the nodes say."""
        safety = self.seen.get("/safety/state")
        states = {k: (m.state, m.text) for k, m in self.seen.items() if k.startswith("/status/")}
        return f"safety: {getattr(safety, 'reason', None)!r}, {states}"

    def pid_of(self, node: str) -> int:
        """Process of a node, from its status."""
        return int(self.seen[f"/status/{node}"].pid)

    def state_of(self, node: str) -> str:
        """State of a node; empty before its first status."""
        status = self.seen.get(f"/status/{node}")
        return "" if status is None else str(status.state)

    @property
    def armed(self) -> bool:
        """Whether the safety node says that it is armed."""
        return bool(getattr(self.seen.get("/safety/state"), "armed", False))

    def say_arm(self, arm: bool = True, source: str = "trial") -> None:
        """Ask for arming or disarming, once."""
        now = SystemClock().now()
        self.bus.publish("/arm", arm_message(RequestIdentity.at(now), now, arm, source, "test"))

    def wait_ready(self, timeout_s: float = 300.0) -> None:
        """Wait for all nodes."""
        self.wait_until(
            lambda: all(self.state_of(name) in _UP for name in self.nodes), timeout_s, "for the nodes"
        )
        self.bus.wait_for_subscribers(["/arm", "/twin/reset"], timeout_s)

    def arm(self, timeout_s: float = 60.0) -> None:
        """Ask for arming until it is granted."""
        asked_s = 0.0

        def is_armed() -> bool:
            nonlocal asked_s
            if not self.armed and time.monotonic() - asked_s > 0.5:
                self.say_arm()
                asked_s = time.monotonic()
            return self.armed

        self.wait_until(is_armed, timeout_s, "to arm")

    def wire(self) -> list[tuple[WireEvent, float, float]]:
        """What the twin's motor controller read, with the car's speed [m/s] and odometer [m]."""
        return read_wire_log(self.run_dir / "vesc_wire.csv")

    def commands_after(self, mono_ns: int) -> list[WireEvent]:
        """Motor commands and time-outs at the controller since an instant."""
        return [event for event, *_ in self.wire() if event.mono_ns >= mono_ns and event.name in MOTOR_EVENTS]
