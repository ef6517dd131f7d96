"""The green-screen graph beside the simulated lab, whose faults are on a string: for campaigns, benchmarks and tests."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from advnerf_core.geometry import planar_pose
from hardware.mocap.vicon import free_udp_port
from nodes.runtime.messages import pose_message
from tests.support.live.operator import LiveOperator
from tests.support.live.processes import REPOSITORY, end
from tests.support.wire_log import read_wire_log

LAUNCH_FILE = REPOSITORY / "launch" / "green_screen.launch.yaml"
VICTIMS = ("camera", "vicon", "compositor", "policy", "safety", "motor")
NODES = ("twin", *VICTIMS)
START = (-1.1, -2.0, 0.0)
CONFIGURED = {"timeout_ms": 250.0, "timeout_brake_current_a": 20.0}
_RULE = "{max_restarts: 1000, delay_s: 0.2, max_delay_s: 0.2}"
_RESPAWNING = (
    "record=false",
    "policy.module=tests.support.live.mad_policy",
    *(f"{name}.required=false" for name in VICTIMS),
    *(f"{name}.respawn={_RULE}" for name in VICTIMS),
)


class BrokenPromise(RuntimeError):
    """The car moved when it should not have, or processes stayed behind."""


class Graph:
    """The simulated lab in a process of its own, and beside it the launch, which is started again when it was killed.

    Args:
        folder: Run folder.
        settings: Overrides of the launch file; None lets nodes that die come back, with a policy that can go mad.
        controller: Time-out of the motor controller [ms], and its brake current then [A].
    """

    def __init__(
        self,
        folder: Path,
        settings: Sequence[str] | None = None,
        controller: Mapping[str, float] = CONFIGURED,
    ) -> None:
        self.folder = folder
        self.settings = _RESPAWNING if settings is None else tuple(settings)
        # Of its own, so that it does not meet a lab, or other tests, that run on this host.
        self._vicon_port = free_udp_port()
        config = folder / "twin.yaml"
        config.write_text(
            json.dumps({"vesc": dict(controller), "vicon": {"port": self._vicon_port}}), encoding="utf-8"
        )
        self.log = (folder / "campaign.log").open("ab")
        arguments = ("--name", "twin", "--config", str(config), "--folder", str(folder))
        self.twin = self._start(
            "tests.support.live.faulty_twin", *arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.operator = LiveOperator(folder, NODES)
        self.supervisor = self.launch()

    def launch(self) -> subprocess.Popen[bytes]:
        """Start the launch; its process."""
        settings = ("twin.if=false", f"params.vicon_port={self._vicon_port}", *self.settings)
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


@contextmanager
def live_graph(
    settings: Sequence[str] | None = None, controller: Mapping[str, float] = CONFIGURED
) -> Iterator[Graph]:
    """A `Graph` in a folder of its own, which goes with it."""
    with tempfile.TemporaryDirectory(prefix="advnerf-") as folder:
        graph = Graph(Path(folder), settings, controller)
        try:
            yield graph
        finally:
            graph.close()
