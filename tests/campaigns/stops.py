"""Is a stop lost when something has run out?

Safety, motor, page and gateways are real processes, and the motor node drives the emulated controller of the twin. While the car
drives, one resource runs out; then a stop is asked for. What counts is the brake that the controller reads on its wire, and what the
caller reads: CONFIRMED or NOT CONFIRMED.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.geometry import planar_pose
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.worlds.lab.vehicle import CarConfig, TwinVehicle
from nodes.lab.trials.trial import Phase, TrialNode, TrialPlan
from nodes.linking.keys import DRIVE, KeyFolder
from nodes.runtime.arm_requests import arm_message, ask_to_arm
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import drive_message, pose_message
from nodes.runtime.process import run_node
from nodes.runtime.requests import RequestIdentity
from tests.support.live.page_client import Browser, cookie_of, request
from tests.support.live.processes import REPOSITORY, end, free_ports

TWIN = REPOSITORY / "calibration" / "twin"
_HOLDERS, _TRIES = 12, 20
_UNLIMITED = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
RESOURCES = ("nothing", "disk", "descriptors", "endpoints", "memory", "hung reader", "full queue")
CELLS = (
    ("page", "estop"),
    ("page", "disarm"),
    ("page without a place", "estop"),
    ("page without a place", "disarm"),
    ("command", "disarm"),
    ("gateway", "disarm"),
    ("trial", "disarm"),
    ("teleop", "estop"),
)


class Rig(threading.Thread):
    """The car on its controller, measured and commanded, and the processes around it."""

    def __init__(self, folder: Path, teleop: bool) -> None:
        super().__init__(daemon=True)
        self.folder, self.teleop, self.stopping = folder, teleop, False
        self.car = VescEmulator(
            VescEmulatorConfig(timeout_ms=250.0, timeout_brake_current_a=20.0),
            TwinVehicle(CarConfig()),
            folder / "vesc",
        )
        self.processes: dict[str, subprocess.Popen[Any]] = {}
        self.start()
        self._run_node(
            "safety", room=str(TWIN / "room.yaml"), vehicle=str(TWIN / "vehicle.yaml"), nodes=["motor"]
        )
        self._run_node(
            "motor", port=str(folder / "vesc"), calibration=str(TWIN / "vehicle.yaml"), steering_check="never"
        )
        if not teleop:
            self._run_node("page", port=0)
        self._gateways()

    def run(self) -> None:
        with Bus(self.folder) as bus:
            next_s = time.monotonic()
            while not self.stopping:
                state = self.car.advance(0.01, time.monotonic_ns())
                pose = planar_pose(state.x_m, state.y_m, state.yaw_rad)
                bus.publish("/vicon/car", pose_message(pose, time.time_ns()))
                bus.publish("/policy/drive", drive_message(0.5, 0.35, time.time_ns()))
                next_s = max(next_s + 0.01, time.monotonic() - 0.1)
                time.sleep(max(0.0, next_s - time.monotonic()))

    def _run_node(self, name: str, folder: Path | None = None, module: str = "", **config: Any) -> None:
        folder = folder or self.folder
        file = folder / f"{name}.json"
        file.write_text(json.dumps(config))
        command = [sys.executable, "-m", f"nodes.{module or name}", "--config", str(file), "--name", name]
        log = open(folder / f"{name}.log", "ab")  # noqa: SIM115 - belongs to the child
        self.processes[name] = subprocess.Popen(
            [*command, "--folder", str(folder)], cwd=REPOSITORY, stdout=log, stderr=log
        )

    def _gateways(self) -> None:
        """A second host on this computer, from which the car is stopped through the link."""
        self.desk = self.folder / "desk"
        self.desk.mkdir()
        ours, theirs = KeyFolder(self.folder / "keys_robot"), KeyFolder(self.folder / "keys_desk")
        theirs.add("robot", ours.new("robot"))
        ours.add("desk", theirs.new("desk"))
        ours.allow("desk", DRIVE)
        ports = dict(zip(("watch_port", "drive_port"), free_ports(2), strict=True))
        seen = ["/safety/state", "/motor/sent"]
        link: dict[str, Any] = {**ports, "exports": seen, "imports": ["/arm"], "keys": str(ours.path)}
        self._run_node("gateway", listen="127.0.0.1", key="robot", **link)
        link = {**ports, "exports": ["/arm"], "imports": seen, "keys": str(theirs.path)}
        self._run_node("gateway_desk", self.desk, "gateway", connect="127.0.0.1", key="desk", **link)

    def wire(self, since_ns: int, name: str) -> int | None:
        """Time of the first event of this name on the controller's wire [ns]."""
        return next((event.mono_ns for event in self.car.events(since_ns) if event.name == name), None)

    def drive(self) -> None:
        """Arm, until the controller is told to move."""
        said = ""
        for _ in range(_TRIES):
            time.sleep(0.3)
            began_ns = time.monotonic_ns()
            with contextlib.suppress(LaunchError):  # no answer yet: asked again
                answer = ask_to_arm(self.folder, "benchmark")
                said = answer.text
                if answer.armed:
                    time.sleep(0.4)
                    if self.wire(began_ns, "SET_RPM") and not self.wire(
                        time.monotonic_ns() - 10**8, "SET_CURRENT_BRAKE"
                    ):
                        return
        raise RuntimeError(f"the car would not drive: {said}")

    def close(self) -> None:
        for process in self.processes.values():
            end(process)
        self.stopping = True
        self.join()
        self.car.close()


@contextlib.contextmanager
def run_out(what: str, rig: Rig) -> Iterator[None]:
    """Let a resource run out for all nodes of the rig."""
    pids = [process.pid for process in rig.processes.values()]
    if what in ("disk", "memory", "descriptors"):
        kind = {
            "disk": resource.RLIMIT_FSIZE,
            "memory": resource.RLIMIT_AS,
            "descriptors": resource.RLIMIT_NOFILE,
        }[what]
        before = {pid: resource.prlimit(pid, kind) for pid in pids}
        for pid in pids:
            resource.prlimit(pid, kind, (_used(what, pid), before[pid][1]))
        try:
            time.sleep(0.1)
            yield
        finally:
            for pid in pids:
                resource.prlimit(pid, kind, before[pid])
    elif what in ("endpoints", "hung reader", "full queue"):
        command = [sys.executable, "-m", "tests.campaigns.stops", what, str(rig.folder)]
        other = subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True)
        try:
            assert other.stdout is not None
            other.stdout.readline()
            if what != "full queue":
                other.send_signal(signal.SIGSTOP)
            yield
        finally:
            other.kill()
            other.wait()
    else:
        yield


def _used(what: str, pid: int) -> int:
    if what == "descriptors":
        return len(os.listdir(f"/proc/{pid}/fd"))
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
    return 0 if what == "disk" else pages * resource.getpagesize()


def disturb(what: str, run_dir: Path) -> None:
    """Be the other process: hold many senders, read and be stopped, or flood the safety node with requests that change nothing."""
    clock = SystemClock()
    with contextlib.ExitStack() as stack:
        buses = [stack.enter_context(Bus(run_dir)) for _ in range(_HOLDERS if what == "endpoints" else 1)]
        for bus in buses:
            if what == "hung reader":
                for topic in ("/arm", "/safety/state", "/safety/drive", "/motor/sent"):
                    bus.subscribe(topic)
            else:
                bus.publisher("/arm")
        time.sleep(0.3)
        print("ready", flush=True)
        while True:
            if what == "full queue":
                now = clock.now()
                # An id that is too long is refused.
                asked = RequestIdentity("x" * 65, now.mono_ns, now.real_ns)
                buses[0].publish("/arm", arm_message(asked, now, True, "benchmark", "flood"))
            else:
                buses[0].wait(0.1)


def end_trial(run_dir: Path) -> None:
    """Be a trial that has driven long enough."""
    node = TrialNode(TrialPlan((0.0, 0.0, 0.0), 0.0, ()), guide=lambda text: print(text, flush=True))
    node.phase = Phase.DRIVING
    node._seen.armed, node.outcome.start_real_ns = True, 1
    run_node(lambda context: node, "trial", run_dir)


Verdict = Callable[[], tuple[str, int]]
"""Waits for what the caller reads: the word, and when it came [ns]."""


def ask(origin: str, kind: str, rig: Rig, browser: Browser | None, keys: int | None) -> Verdict:
    """Ask for a stop."""
    if origin == "page":
        assert browser is not None
        before = browser.state["stops"][0]
        browser.act(kind)
        return lambda: _page_verdict(browser, before)
    if origin == "page without a place":
        assert browser is not None
        found: list[tuple[str, int]] = []
        thread = threading.Thread(target=lambda: found.append(_request_verdict(rig, kind)))
        thread.start()

        def answer() -> tuple[str, int]:
            thread.join()
            return found[0]

        return answer
    if origin == "teleop":
        assert keys is not None
        os.write(keys, b" ")
        return lambda: _teleop_verdict(rig)
    folder = rig.desk if origin == "gateway" else rig.folder
    words = (
        ["-m", "tests.campaigns.stops", "trial"]
        if origin == "trial"
        else ["-m", "nodes.cli", "disarm", "--folder"]
    )
    process = subprocess.Popen(
        [sys.executable, *words, str(folder)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return lambda: _line_verdict(process)


def _line_verdict(process: subprocess.Popen[str]) -> tuple[str, int]:
    assert process.stdout is not None
    line = process.stdout.readline()
    at_ns = time.monotonic_ns()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(30.0)
    process.kill()
    process.wait()
    return (
        "NOT CONFIRMED" if "NOT CONFIRMED" in line else "CONFIRMED" if "CONFIRMED" in line else "-"
    ), at_ns


def _page_verdict(browser: Browser, before: int) -> tuple[str, int]:
    deadline = time.monotonic() + 1.0
    while time.monotonic() < deadline:
        asked, confirmed = browser.state["stops"]
        if asked == confirmed > before:
            return "CONFIRMED", time.monotonic_ns()
        time.sleep(0.005)
    return "NOT CONFIRMED", time.monotonic_ns()


def _request_verdict(rig: Rig, kind: str) -> tuple[str, int]:
    port = _port(rig)
    headers = {"Origin": f"http://127.0.0.1:{port}", "Cookie": cookie_of(port)}
    answer = json.loads(request(port, f"/stop/{kind}", headers, "POST")[2])
    return ("CONFIRMED" if answer["confirmed"] else "NOT CONFIRMED"), time.monotonic_ns()


def _teleop_verdict(rig: Rig) -> tuple[str, int]:
    time.sleep(0.5)
    said = (rig.folder / "teleop.log").read_text().splitlines()[-1:]
    return ("NOT CONFIRMED" if said and "NOT CONFIRMED" in said[0] else "CONFIRMED"), time.monotonic_ns()


def _port(rig: Rig) -> int:
    door = rig.folder / "page" / "door.json"
    deadline = time.monotonic() + 60.0
    while not door.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    return int(read_json(door)["url"].rstrip("/").rpartition(":")[2])


def measure(
    rig: Rig, origin: str, kind: str, what: str, browser: Browser | None, keys: int | None
) -> dict[str, Any]:
    """One stop: time to the brake on the wire, the caller's word and when it came [ms], and whether the car was stopped before."""
    rig.drive()
    drove_ns = time.monotonic_ns()
    with run_out(what, rig):
        since_ns = time.monotonic_ns()
        word, word_ns = ask(origin, kind, rig, browser, keys)()
        deadline = time.monotonic() + 2.0
        while (brake_ns := rig.wire(since_ns, "SET_CURRENT_BRAKE")) is None and time.monotonic() < deadline:
            time.sleep(0.01)
    if kind == "estop":
        _reset(browser, keys)
    first_ns = rig.wire(drove_ns, "SET_CURRENT_BRAKE")
    return {
        "stopped_before": first_ns is not None and first_ns < since_ns,
        "brake_ms": None if brake_ns is None else (brake_ns - since_ns) / 1e6,
        "word": word,
        "word_ms": (word_ns - since_ns) / 1e6,
    }


def _reset(browser: Browser | None, keys: int | None) -> None:
    if keys is not None:
        os.write(keys, b"r")
    elif browser is not None:
        browser.wait(lambda: browser.state["estop"], "the latch")
        number = browser.act("take", name="benchmark")
        browser.wait(lambda: any(a.get("n") == number for a in browser.answers), "the lease")
        browser.do("reset_estop")


@contextlib.contextmanager
def rig_of(teleop: bool) -> Iterator[tuple[Rig, Browser | None, int | None]]:
    with tempfile.TemporaryDirectory(prefix="advnerf-") as folder:
        rig = Rig(Path(folder), teleop)
        browser, keys, teleoperator = None, None, None
        try:
            if teleop:
                keys, other = pty.openpty()
                with open(Path(folder) / "teleop.log", "wb") as log:
                    command = [sys.executable, "-m", "nodes.teleop", "--folder", folder, "--name", "teleop"]
                    teleoperator = subprocess.Popen(
                        command, cwd=REPOSITORY, stdin=other, stdout=log, stderr=log
                    )
                rig.processes["teleop"] = teleoperator
                os.close(other)
            else:
                browser = Browser(_port(rig))
            yield rig, browser, keys
        finally:
            if browser is not None:
                browser.close()
            rig.close()
            if keys is not None:
                os.close(keys)


if __name__ == "__main__":
    if sys.argv[1] == "trial":
        end_trial(Path(sys.argv[2]))
    else:
        disturb(sys.argv[1], Path(sys.argv[2]))
