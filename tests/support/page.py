"""Helper of the page's tests: a run with a real page, a real safety process, and a car as far as both can tell."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from advnerf_core.geometry import planar_pose
from nodes.runtime.bus import Bus
from nodes.runtime.messages import drive_message, header, image_message, pose_message, types
from tests.support.messages import filled
from tests.support.waiting import wait_for

REPOSITORY = Path(__file__).parents[2]
TWIN = REPOSITORY / "calibration" / "twin"
STOP_S = 0.35
# By default a stop may take its time; the tests that hold it to the clock want a quiet machine.
IN_TIME = [pytest.param(60.0, id=""), pytest.param(STOP_S, id="in time", marks=pytest.mark.timing)]


class Car(threading.Thread):
    """A car that is measured, seen and commanded, as far as page and safety node can tell; and the test's eyes on the bus."""

    def __init__(self, folder):
        super().__init__(daemon=True)
        self.folder, self.stopping = folder, False
        self.newest, self.acts, self.moves, self.heard = {}, [], [], {}
        self.pictures = self.motor = self.compositor = True
        self.x_m = self.goes_to_m = 0.0

    def run(self):
        heard = (
            "/safety/state",
            "/safety/drive",
            "/operator/act",
            "/attack/file",
            "/attack/switch",
            "/status/page",
        )
        with Bus(self.folder) as bus:
            for topic in heard:
                bus.subscribe(topic, queue=1000)
            next_s, tick = time.monotonic(), 0
            while not self.stopping:
                bus.wait(max(0.0, next_s - time.monotonic()))
                for received in bus.receive():
                    self._hear(received)
                if time.monotonic() < next_s:
                    continue
                next_s, tick = next_s + 0.02, tick + 1
                self._say(bus, tick)

    def _hear(self, received):
        message = received.message()
        self.newest[received.topic] = message
        self.heard.setdefault(received.topic, []).append((received.info.publish_mono_ns, message))
        if received.topic == "/operator/act":
            self.acts.append(message)
        elif received.topic == "/safety/drive":
            self.moves.append((received.info.publish_mono_ns, float(message.drive.speed)))

    def _say(self, bus, tick):
        now_ns = time.time_ns()
        if self.armed and self.moves and self.moves[-1][1] > 0.0:
            self.x_m = min(self.x_m + 0.006, self.goes_to_m)  # 0.3 m/s
        bus.publish("/vicon/car", pose_message(planar_pose(self.x_m, 0.0, 0.0), now_ns))
        bus.publish("/policy/drive", drive_message(0.5, 0.0, now_ns))
        if self.motor and self.moves:
            bus.publish("/motor/sent", motor_sent(self.moves[-1][1], now_ns))
        if tick % 5 == 0 and self.pictures:
            rgb = np.full((188, 336, 3), tick % 255, np.uint8)
            for topic in ("/camera/image_raw", *(["/compositor/image"] if self.compositor else ())):
                bus.publish(topic, image_message(rgb, now_ns, "camera"))

    @property
    def armed(self):
        return bool(getattr(self.newest.get("/safety/state"), "armed", False))

    @property
    def reason(self):
        return getattr(self.newest.get("/safety/state"), "reason", "")

    def stop_after(self, since_ns):
        """Seconds from an instant to the first stop after the last command to move."""

        def stops():
            moves = list(self.moves)
            last_ns = max((t for t, speed in moves if speed > 0.0), default=0)
            return [t for t, speed in moves if speed == 0.0 and t > last_ns]

        return (wait_for(stops, "the car to be stopped")[0] - since_ns) / 1e9


def motor_sent(speed_mps, stamp_ns):
    """What a motor node reports that does what it is told."""
    return filled(
        types.MotorSent,
        header=header(stamp_ns),
        serial_write_real_ns=stamp_ns,
        speed_mps=speed_mps,
        servo=0.5,
        braking=speed_mps == 0.0,
        peer="TWIN",
    )


class Run:
    """A run folder with page, safety node and car."""

    def __init__(self, folder, teleop="hold", **config):
        self.folder, self.processes = folder, {}
        self.car = Car(folder)
        safety = {
            "room": str(TWIN / "room.yaml"),
            "vehicle": str(TWIN / "vehicle.yaml"),
            "nodes": [],
            "teleop": teleop,
        }
        page = {"port": 0, "room": str(TWIN / "room.yaml"), **config}
        self.configs = {"safety": safety, "page": page}
        nodes = {name: {"module": f"nodes.{name}", "config": config} for name, config in self.configs.items()}
        (folder / "launch.resolved.yaml").write_text(yaml.safe_dump({"name": "test", "nodes": nodes}))

    def start(self, *names, environment=None):
        for name in names or self.configs:
            file = self.folder / f"{name}.yaml"
            file.write_text(yaml.safe_dump(self.configs[name]))
            command = [sys.executable, "-m", f"nodes.{name}", "--config", str(file)]
            log = open(self.folder / f"{name}.log", "ab")  # noqa: SIM115 - belongs to the child
            self.processes[name] = subprocess.Popen(
                [*command, "--folder", str(self.folder), "--name", name],
                stdout=log,
                stderr=log,
                cwd=REPOSITORY,
                env={**os.environ, **(environment or {})},
            )
        if not self.car.is_alive():
            self.car.start()
        self.wait(lambda: (self.folder / "page" / "door.json").exists(), "the page")
        if "safety" in self.processes:
            self.wait(lambda: "/safety/state" in self.car.newest, "the safety node")
        return self

    @property
    def door(self):
        return json.loads((self.folder / "page" / "door.json").read_text())

    @property
    def port(self):
        return int(self.door["url"].rstrip("/").rpartition(":")[2])

    def log(self):
        """What the page wrote about acts."""
        return [json.loads(line) for line in (self.folder / "page" / "acts.jsonl").read_text().splitlines()]

    def counter(self, name):
        status = self.car.newest["/status/page"]
        return dict(zip(status.counter_names, status.counter_values, strict=True))[name]

    def wait(self, condition, what, timeout_s=60.0):
        deadline = time.monotonic() + timeout_s
        while not condition():
            for name, process in self.processes.items():
                assert process.poll() is None, (
                    f"{name} ended: {(self.folder / f'{name}.log').read_text()[-2000:]}"
                )
            assert time.monotonic() < deadline, f"gave up waiting for {what}; the car is {self.car.reason!r}"
            time.sleep(0.01)

    def close(self):
        self.car.stopping = True
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self.processes.values():
            process.wait(120)
        if self.car.is_alive():
            self.car.join()
