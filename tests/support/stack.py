"""Helper of the stack tests: the real nodes as processes, with a policy that always drives straight on."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import yaml

from advnerf_core.geometry import planar_pose
from hardware.emulators.vesc_firmware import WireEvent
from hardware.mocap.vicon import free_udp_port
from nodes.runtime.messages import pose_message
from nodes.runtime.paths import bus_folder
from tests.support.live.operator import LiveOperator
from tests.support.live.processes import REPOSITORY
from tests.support.spoiled import Spoiled, unspoiled

CALIBRATION = REPOSITORY / "calibration" / "twin"
NODES = ("twin", "camera", "vicon", "compositor", "policy", "safety", "motor")
BRAKES = ("SET_CURRENT_BRAKE", "TIMEOUT")
START = (-1.1, -2.0, 0.0)
TIMEOUT = {"timeout_ms": 250.0, "timeout_brake_current_a": 20.0}


class Stack(LiveOperator):
    """All processes of one live run, and the test's own eyes and hands on the bus."""

    def __init__(self, run_dir: Path, vesc: dict | None = None):
        super().__init__(run_dir, NODES)
        self.processes: dict[str, subprocess.Popen] = {}
        port = free_udp_port()
        self.configs = {
            "twin": {"vicon": {"port": port}, "vesc": vesc or TIMEOUT, "start_pose": list(START)},
            "camera": {
                "source": {"kind": "socket", "path": str(bus_folder(run_dir) / "frames")},
                "calibration": str(CALIBRATION / "camera.yaml"),
            },
            "vicon": {"port": port, "subjects": ["car", "board"]},
            "compositor": {
                "camera": str(CALIBRATION / "camera.yaml"),
                "target": str(CALIBRATION / "board.yaml"),
            },
            "policy": {"speed_mps": 0.8},
            "safety": {"room": str(CALIBRATION / "room.yaml"), "vehicle": str(CALIBRATION / "vehicle.yaml")},
            "motor": {"port": str(run_dir / "vesc"), "calibration": str(CALIBRATION / "vehicle.yaml")},
        }

    def start(self, *names: str) -> None:
        for name in names or NODES:
            self.processes[name] = self._start(name)

    def _start(self, name: str) -> subprocess.Popen:
        arguments = ["--folder", str(self.run_dir), "--name", name]
        config = self.run_dir / f"{name}.yaml"
        config.write_text(yaml.safe_dump(self.configs[name]))
        module = "tests.support.live.straight_policy" if name == "policy" else f"nodes.{name}"
        command = [sys.executable, "-m", module, "--config", str(config), *arguments]
        log = open(self.run_dir / f"{name}.log", "ab")  # noqa: SIM115 - belongs to the child
        # A session of its own, as in a launch: where sessions share the processors, each node has a share.
        return subprocess.Popen(command, stdout=log, stderr=log, cwd=REPOSITORY, start_new_session=True)

    def check(self) -> None:
        for name, process in self.processes.items():
            log = self.run_dir / f"{name}.log"
            assert process.poll() in (None, -signal.SIGKILL), f"{name} ended: {log.read_text()[-2000:]}"

    def drive(self, duration_s: float = 1.2) -> None:
        """Drive from the start; the car is driving afterwards."""

        def attempt() -> None:
            self.wait_ready()
            self.put_back()
            self.arm()
            self.watch(duration_s)
            if not self.armed:
                raise Spoiled(self.seen["/safety/state"].reason)

        unspoiled(attempt)

    def put_back(self) -> None:
        """Wait until the car stands and lift it to the start."""
        resets = sum(event.name == "PLACED" for event, *_ in self.wire())

        def placed() -> bool:
            # Stamped anew each time: the twin refuses an old request.
            self.bus.publish("/twin/reset", pose_message(planar_pose(*START), time.time_ns()))
            self.watch(0.3)
            return sum(event.name == "PLACED" for event, *_ in self.wire()) > resets

        self.wait_until(placed, 60.0, "to put the car back")

    def disarm(self) -> None:
        """Disarm, and wait until the car's motor is released."""

        def disarmed() -> bool:
            self.say_arm(False)
            self.watch(0.3)
            return self.seen["/safety/state"].reason == "disarmed by trial: test"

        self.wait_until(disarmed, 60.0, "to be disarmed")
        self.wait_until(lambda: self.commands_after(0)[-1].name == "SET_CURRENT", 60.0, "to be released")

    def stopped(self, since_ns: int) -> list[WireEvent]:
        """Wait for the end of a stop; the motor commands from its first brake on."""

        def stop() -> list[WireEvent]:
            events = self.commands_after(since_ns)
            first = next((k for k, event in enumerate(events) if event.name in BRAKES), len(events))
            return events[first:]

        self.wait_until(
            lambda: any(event.name == "SET_CURRENT" for event in stop()), 60.0, "for brake and release"
        )
        return stop()

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
                process.wait(120)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
