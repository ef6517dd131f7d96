"""Helpers of the stack tests: the real device nodes as processes, with minimal stand-ins for compositor and policy.

Run as a program it is one of the stand-ins: ``python stack.py --run-dir DIR --name policy|compositor``.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import yaml
from pydantic import BaseModel

from advnerf_core.geometry import planar_pose
from hardware.twin.vesc_emulator import read_wire_log
from nodes.runtime.bus import Bus
from nodes.runtime.messages import drive_message, encode, header, ns_from_stamp, pose_message, types
from nodes.runtime.node import Node, Out, run_node_main

CALIBRATION = Path(__file__).parents[2] / "calibration" / "twin"
NODES = ("twin", "camera", "vicon", "compositor", "policy", "safety", "motor")
START = (-1.1, -2.0, 0.0)
TIMEOUT = {"timeout_ms": 250.0, "timeout_brake_current_a": 20.0}


class StandInConfig(BaseModel):
    pass


class PassThrough(Node):
    """A compositor without an attack."""

    subscriptions = ("/camera/image_raw",)
    publications = ("/compositor/image",)
    raw = True

    def handle(self, topic, message, info, now):
        return [Out("/compositor/image", info.raw)]


class Straight(Node):
    """A policy with one idea."""

    subscriptions = ("/compositor/image",)
    publications = ("/policy/drive",)

    def handle(self, topic, message, info, now):
        return [Out("/policy/drive", drive_message(0.8, 0.02, ns_from_stamp(message.header.stamp)))]


def free_udp_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Stack:
    """All processes of one live run, and the test's own eyes and hands on the bus."""

    def __init__(self, run_dir: Path, vesc: dict | None = None):
        self.run_dir = run_dir
        self.processes: dict[str, subprocess.Popen] = {}
        port = free_udp_port()
        self.configs = {
            "twin": {"vicon": {"port": port}, "vesc": vesc or TIMEOUT, "start_pose": list(START)},
            "camera": {
                "source": {"kind": "socket", "path": str(run_dir / "frames")},
                "calibration": str(CALIBRATION / "camera.yaml"),
            },
            "vicon": {"port": port, "subjects": ["car", "board"]},
            "safety": {"room": str(CALIBRATION / "room.yaml")},
            "motor": {"port": str(run_dir / "vesc"), "calibration": str(CALIBRATION / "vehicle.yaml")},
        }
        self.bus = Bus(run_dir)
        for topic in ("/safety/state", "/vicon/car", "/motor/sent", "/motor/state"):
            self.bus.subscribe(topic)
        for name in NODES:
            self.bus.subscribe(f"/status/{name}")
        self.seen: dict[str, object] = {}
        self.all_sent: list[object] = []

    def start(self, *names: str) -> None:
        for name in names or NODES:
            self.processes[name] = self._start(name)

    def _start(self, name: str) -> subprocess.Popen:
        arguments = ["--run-dir", str(self.run_dir), "--name", name]
        if name in self.configs:
            config = self.run_dir / f"{name}.yaml"
            config.write_text(yaml.safe_dump(self.configs[name]))
            command = [sys.executable, "-m", f"nodes.{name}", "--config", str(config), *arguments]
        else:
            command = [sys.executable, __file__, *arguments]
        log = open(self.run_dir / f"{name}.log", "ab")  # noqa: SIM115 - belongs to the child
        return subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, "MUJOCO_GL": "egl"})

    def watch(self, duration_s: float = 0.0) -> None:
        deadline = time.monotonic() + duration_s
        while True:
            self.bus.wait(max(0.0, min(0.02, deadline - time.monotonic())))
            for received in self.bus.receive():
                message = received.message()
                self.seen[received.topic] = message
                if received.topic == "/motor/sent":
                    self.all_sent.append(message)
            if time.monotonic() >= deadline:
                return

    def wait_until(self, condition, timeout_s: float = 30.0, what: str = "") -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"gave up waiting {what}: {self.describe()}"
            for name, process in self.processes.items():
                log = self.run_dir / f"{name}.log"
                assert process.poll() in (None, -signal.SIGKILL), f"{name} ended: {log.read_text()[-2000:]}"
            self.watch(0.02)

    def describe(self) -> str:
        safety = self.seen.get("/safety/state")
        states = {k: (m.state, m.text) for k, m in self.seen.items() if k.startswith("/status/")}
        return f"safety: {getattr(safety, 'reason', None)!r}, {states}"

    def state_of(self, name: str) -> str:
        status = self.seen.get(f"/status/{name}")
        return "" if status is None else status.state

    @property
    def armed(self) -> bool:
        return bool(getattr(self.seen.get("/safety/state"), "armed", False))

    def say_arm(self, arm: bool = True, source: str = "trial") -> None:
        self.bus.publish("/arm", types.Arm(header=header(time.time_ns()), arm=arm, source=source, reason="test"))

    def wait_ready(self) -> None:
        alive = ("ready", "active")
        self.wait_until(lambda: all(self.state_of(name) in alive for name in NODES), what="for the nodes")
        self.bus.wait_for_subscribers(["/arm", "/twin/reset"], 10.0)

    def arm(self) -> None:
        asked = 0.0

        def is_armed():
            nonlocal asked
            if time.monotonic() - asked > 0.5:
                self.say_arm()
                asked = time.monotonic()
            return self.armed

        self.wait_until(is_armed, 15.0, "to arm")

    def drive(self, duration_s: float = 1.2) -> None:
        self.wait_ready()
        self.arm()
        self.watch(duration_s)
        assert self.armed, self.describe()

    def put_back(self) -> None:
        """Wait until the car stands and lift it to the start."""
        pose = encode(pose_message(planar_pose(*START), time.time_ns()))
        resets = sum(event.name == "PLACED" for event, *_ in self.wire())

        def placed():
            self.bus.publish("/twin/reset", pose)
            self.watch(0.3)
            return sum(event.name == "PLACED" for event, *_ in self.wire()) > resets

        self.wait_until(placed, 10.0, "to put the car back")

    def wire(self):
        return read_wire_log(self.run_dir / "vesc_wire.csv")

    def signal(self, name: str, number: int) -> int:
        """Send a signal; monotonic time at which it was sent [ns]."""
        before_ns = time.monotonic_ns()
        self.processes[name].send_signal(number)
        return before_ns

    def close(self) -> None:
        self.bus.close()
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


if __name__ == "__main__":
    kind = {"policy": Straight, "compositor": PassThrough}[sys.argv[sys.argv.index("--name") + 1]]
    raise SystemExit(run_node_main(StandInConfig, lambda config, context: kind()))
