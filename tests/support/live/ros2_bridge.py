"""The ROS 2 node as a process, between ROS programs and a test."""

import signal
import subprocess
import sys
import time

import yaml

from nodes.runtime.bus import Bus
from tests.support.live.processes import REPOSITORY

VEHICLE = REPOSITORY / "calibration" / "twin" / "vehicle.yaml"


class Bridge:
    """The ROS 2 node as a process, and the test's own place on the bus."""

    def __init__(self, run_dir, config, domain):
        self.bus = Bus(run_dir)
        self.bus.subscribe("/status/ros2")
        self.got = []
        self.counters = {}
        for route in config.get("take", ()):
            self.bus.subscribe(route["topic"], queue=1000)
        for route in config["send"]:
            self.bus.publisher(route["topic"])
        file = run_dir / "ros2.yaml"
        file.write_text(yaml.safe_dump({"domain_id": domain, "vehicle": str(VEHICLE), **config}))
        command = [sys.executable, "-m", "nodes.ros2", "--config", str(file), "--folder", str(run_dir)]
        self.process = subprocess.Popen(command, cwd=REPOSITORY)
        self.bus.wait_for_subscribers([route["topic"] for route in config["send"]], 20.0)

    def watch(self, duration_s=0.0):
        deadline = time.monotonic() + duration_s
        while True:
            self.bus.wait(max(0.0, min(0.02, deadline - time.monotonic())))
            for received in self.bus.receive():
                message = received.message()
                if received.topic == "/status/ros2":
                    self.counters = dict(zip(message.counter_names, message.counter_values, strict=True))
                    self.state = message.state, message.text
                else:
                    self.got.append((received, message))
            if time.monotonic() >= deadline:
                return

    def wait_for_readers(self, *names):
        deadline = time.monotonic() + 120.0
        while not all(self.counters.get(f"readers {name}") for name in names):
            assert time.monotonic() < deadline, self.counters
            self.watch(0.1)

    def close(self):
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(120) == 0
        self.bus.close()
