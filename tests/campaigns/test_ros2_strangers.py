"""Can a stranger among the ROS programs make the car do what its operator did not allow? 40 minutes in full.

The shipped ROS 2 launch drives the simulated lab; an honest policy, a program of its own, answers each image with one fixed command.
Strangers act, one at a time (`tests.support.live.ros2_strangers`): half of the time beside the honest policy while the car drives, the other
half alone while it is disarmed and must stay where it is. What may reach the motor is known: the honest command while the operator's arming lasts, and stops. Anything
else that moves, and any arming that the operator did not ask for, is a failure. To stop is always allowed.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from advnerf_core.geometry import planar_pose
from hardware.mocap.vicon import free_udp_port
from nodes.runtime.messages import encode, pose_message
from tests.campaigns.campaign import Campaign
from tests.support.live.operator import LiveOperator
from tests.support.live.processes import REPOSITORY
from tests.support.live.ros2_strangers import (
    HONEST_SPEED_MPS,
    HONEST_STEERING_RAD,
    STRANGERS,
    ZENOH_STRANGERS,
)
from tests.support.live.zenoh_router import zenoh_router

NODES = ("twin", "camera", "vicon", "compositor", "ros2", "safety", "motor")
# A circle on free floor; the honest policy drives it for ever.
START = (-2.2, -3.04, 0.0)
_ACT_S, _SETTLE_S = 1.5, 0.4
_TOLERANCE = 1e-3
# A busy machine may be late with a command, and then the car stops before the stranger comes.
_ATTEMPTS, _DOMAIN = 20, 61


class Programs:
    """The launch, the honest policy and the strangers' process."""

    def __init__(self, folder: Path, domain: int, transport: str) -> None:
        self.run_dir, self._domain, self._transport = folder / "run", domain, transport
        self._router = contextlib.ExitStack()
        zenoh = [self._router.enter_context(zenoh_router())] if transport == "zenoh" else []
        settings = (
            f"params.transport={transport}",
            *(f"ros2.zenoh.connect=[{endpoint}]" for endpoint in zenoh),
            f"params.domain_id={domain}",
            f"params.vicon_port={free_udp_port()}",
            f"twin.start_pose={list(START)}",
            "record=false",
        )
        options = [word for setting in settings for word in ("--set", setting)]
        launch = ["launch", "launch/ros2.launch.yaml", "--folder", str(self.run_dir), *options]
        self._log = open(folder / "launch.log", "wb")  # noqa: SIM115 - belongs to the child
        self._launch = subprocess.Popen(
            [sys.executable, "-m", "nodes.cli.main", *launch],
            cwd=REPOSITORY,
            stdout=self._log,
            stderr=self._log,
        )
        self._honest: subprocess.Popen[str] | None = None
        self._stranger = self._start()

    def start_honest(self) -> None:
        """Start the operator's own policy, if it does not run."""
        self._honest = self._honest or self._start("--honest")

    def stop_honest(self) -> None:
        """End the operator's own policy; it leaves the domain as a program that is ended."""
        if self._honest is not None:
            self._honest.terminate()
            self._honest.wait()
            self._honest = None

    def act(self, kind: str, seed: int) -> None:
        """Let a stranger begin; `acting` says when it is done."""
        request = {"kind": kind, "seconds": _ACT_S, "seed": seed}
        assert self._stranger.stdin is not None
        self._stranger.stdin.write(json.dumps(request) + "\n")
        self._stranger.stdin.flush()
        os.set_blocking(self._pipe(), False)

    @property
    def acting(self) -> bool:
        """Whether the stranger still acts."""
        if self._stranger.poll() is not None:
            raise RuntimeError("the strangers' process ended; run tests.support.live.ros2_strangers by hand")
        with contextlib.suppress(BlockingIOError):
            return b"done" not in os.read(self._pipe(), 4096)
        return True

    def check(self) -> None:
        """Raise if the launch has ended."""
        if self._launch.poll() is not None:
            raise RuntimeError(f"the launch ended: {Path(self._log.name).read_text()[-2000:]}")

    def close(self) -> None:
        """End all processes."""
        for process in (self._honest, self._stranger):
            if process is not None:
                process.kill()
                process.wait()
        self._launch.send_signal(signal.SIGINT)
        try:
            self._launch.wait(20.0)
        except subprocess.TimeoutExpired:
            self._launch.kill()
        self._log.close()
        self._router.close()

    def _pipe(self) -> int:
        assert self._stranger.stdout is not None
        return self._stranger.stdout.fileno()

    def _start(self, *options: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.support.live.ros2_strangers", str(self._domain)]
        command += ["--transport", self._transport, *options]
        process = subprocess.Popen(
            command,
            cwd=REPOSITORY,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process


class Watcher(LiveOperator):
    """The operator, who also checks every command that leaves the safety node."""

    def __init__(self, programs: Programs) -> None:
        super().__init__(programs.run_dir, NODES)
        self._programs = programs
        self.bus.subscribe("/safety/drive", queue=500)
        self.allowed = False
        self.failures: list[str] = []
        self.moves = 0

    def check(self) -> None:
        """Raise if the launch has ended."""
        self._programs.check()

    def heard(self, topic: str, message: Any) -> None:
        """Note what the operator did not allow."""
        super().heard(topic, message)
        if topic == "/safety/drive":
            self._judge(message.drive)
        elif topic == "/safety/state" and message.armed and not self.allowed:
            self.failures.append(f"armed by {message.source} without being asked")

    def say_arm(self, arm: bool = True, source: str = "trial") -> None:
        """Ask, and remember that the operator allows or forbids motion."""
        self.allowed = arm
        super().say_arm(arm, source)

    def _judge(self, drive: Any) -> None:
        if drive.speed == 0.0:
            return
        self.moves += 1
        honest = (
            abs(drive.speed - HONEST_SPEED_MPS) < _TOLERANCE
            and abs(drive.steering_angle - HONEST_STEERING_RAD) < _TOLERANCE
        )
        if not honest or not self.allowed:
            self.failures.append(
                f"{drive.speed:.3f} m/s, {drive.steering_angle:.3f} rad, allowed: {self.allowed}"
            )


def put_back(watcher: Watcher) -> None:
    """Lift the standing car to its start."""
    watcher.bus.publish("/twin/reset", encode(pose_message(planar_pose(*START), time.time_ns())))
    watcher.watch(0.3)


def prepare(watcher: Watcher, programs: Programs, driving: bool) -> None:
    """Bring the car into the state in which a stranger meets it."""
    if not driving:
        programs.stop_honest()
        watcher.say_arm(False)
        watcher.wait_until(lambda: not watcher.armed, 10.0, "to be disarmed")
        watcher.watch(0.3)  # what was on its way
        watcher.allowed = False
        return
    programs.start_honest()
    watcher.wait_until(
        lambda: watcher.state_of("ros2") == "active", 40.0, "for the honest policy to be alone"
    )
    for _ in range(_ATTEMPTS):
        if not watcher.armed:
            put_back(watcher)
            watcher.arm(30.0)
        before = watcher.moves
        watcher.watch(0.4)
        if watcher.armed and watcher.moves >= before + 2:
            return
    raise RuntimeError(f"the car does not drive on this machine: {watcher.describe()}")


def run_case(
    watcher: Watcher, programs: Programs, kind: str, seed: int, driving: bool
) -> tuple[list[str], bool]:
    """Let one stranger act. Returns what was not allowed, and whether the car was stopped."""
    prepare(watcher, programs, driving)
    watcher.failures.clear()
    programs.act(kind, seed)
    stopped = False
    while programs.acting:
        watcher.check()
        watcher.watch(0.05)
        if driving and not watcher.armed and not stopped:
            stopped, watcher.allowed = (
                True,
                False,
            )  # from here on nothing may move until the operator arms again
    watcher.watch(_SETTLE_S)
    return list(watcher.failures), stopped


def run(count: int, domain: int, transport: str) -> tuple[list[str], Counter[str], Counter[str]]:
    """All cases: what failed, how many of each kind there were while driving, and how many of these stopped the car."""
    failed: list[str] = []
    driven: Counter[str] = Counter()
    stops: Counter[str] = Counter()
    rng = random.Random(0)
    kinds = [*STRANGERS, *(ZENOH_STRANGERS if transport == "zenoh" else ())]
    with tempfile.TemporaryDirectory(prefix="advnerf-ros2-") as folder:
        programs = Programs(Path(folder), domain, transport)
        watcher = Watcher(programs)
        try:
            watcher.wait_ready(90.0)
            for number in range(count):
                kind, driving = kinds[number // 2 % len(kinds)], number % 2 == 0
                failures, stopped = run_case(watcher, programs, kind, rng.getrandbits(32), driving)
                driven[kind] += driving
                stops[kind] += stopped
                failed += [f"{number} {kind}: {failures[0]} ({len(failures)} times)"] if failures else []
                state = "stopped" if stopped else "driving" if driving else "at rest"
                print(
                    f"{number + 1:3d} {kind:17s} {state:8s} {failures[:2] or 'nothing that was not allowed'}",
                    flush=True,
                )
        finally:
            watcher.bus.close()
            programs.close()
    return failed, driven, stops


@pytest.mark.campaign
@pytest.mark.parametrize(("transport", "name"), [("dds", "DDS"), ("zenoh", "Zenoh")])
def test_no_stranger_makes_the_car_do_what_its_operator_did_not_allow(
    campaign: Campaign, transport: str, name: str
) -> None:
    cases = campaign.size(6, 200)
    failed, driven, stops = run(cases, _DOMAIN, transport)
    kept = [kind for kind in driven if driven[kind] and not stops[kind]]
    always = [kind for kind in driven if driven[kind] and stops[kind] == driven[kind]]
    campaign.record(
        f"{name} strangers and floods: cases in which the car did nothing that its operator did not allow",
        cases - len(failed),
        f"of {cases}",
        f"{cases}",
        not failed,
        f"{len(driven)} kinds, half of the cases while driving; always stopped by {', '.join(always) or 'none'};"
        f" never by {', '.join(kept) or 'none'}",
    )
    assert failed == []
