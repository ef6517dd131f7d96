"""The car and the workstation as two hosts: two network namespaces, a launch in each, keys, and a person at the workstation.

The simulated lab stands in the car's namespace, beside the launch: like a real car it does not vanish with the software.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.results import REPOSITORY
from nodes.linking.keys import DRIVE, KeyFolder
from nodes.runtime.bus import Bus
from nodes.runtime.paths import bus_folder
from tests.support.live.graph import CONFIGURED, BrokenPromise
from tests.support.live.network import ADDRESSES, Cable
from tests.support.live.operator import LiveOperator
from tests.support.live.processes import end
from tests.support.wire_log import read_wire_log

LAUNCH_FILE = REPOSITORY / "launch" / "two_hosts.launch.yaml"
NODES = ("camera", "vicon", "compositor", "policy", "safety", "motor")
ROBOT, WORKSTATION = "robot", "workstation"
STOPS = ("SET_CURRENT_BRAKE", "TIMEOUT")
MOVES = ("SET_RPM", "MOVING")
# The safety node's limit: a command that was older when it came is not fresh.
_FRESH_NS = 220_000_000
_VICON_PORT = 51001
# Real time alone is moved: ages on one host are monotonic, and no namespace of the kernel holds a real clock of its own.
_SKEW_SOURCE = r"""
#define _GNU_SOURCE
#include <stdlib.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>
static long skew_ns(void) {
    const char *text = getenv("SKEW_NS");
    return text ? atol(text) : 0;
}
int clock_gettime(clockid_t id, struct timespec *t) {
    int failed = syscall(SYS_clock_gettime, id, t);
    if (!failed && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) {
        long long ns = t->tv_sec * 1000000000LL + t->tv_nsec + skew_ns();
        t->tv_sec = ns / 1000000000LL;
        t->tv_nsec = ns % 1000000000LL;
    }
    return failed;
}
int gettimeofday(struct timeval *t, void *zone) {
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    t->tv_sec = now.tv_sec;
    t->tv_usec = now.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *out) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (out) *out = now.tv_sec;
    return now.tv_sec;
}
"""


def skewed_clock(folder: Path, skew_s: float) -> dict[str, str]:
    """Environment in which real time is off by so much [s]; compiles a library for the dynamic loader."""
    source, library = folder / "skew.c", folder / "skew.so"
    source.write_text(_SKEW_SOURCE, encoding="ascii")
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    environment = {"LD_PRELOAD": str(library), "SKEW_NS": str(round(skew_s * 1e9))}
    told = subprocess.run(
        [sys.executable, "-c", "import time; print(time.time())"],
        env={**os.environ, **environment},
        capture_output=True,
        check=True,
        text=True,
    )
    # It must have taken hold: a test with the right clock would prove nothing.
    if abs(time.time() - float(told.stdout) + skew_s) > max(0.04, skew_s / 2):
        raise BrokenPromise(
            f"expected a clock that is {skew_s} s ahead, it says {told.stdout} at {time.time()}"
        )
    return environment


class Person(LiveOperator):
    """The operator at the workstation, who also has an ear at the car.

    Args:
        workstation: Run folder of the workstation's launch: what is seen and said goes over the link.
        car: Run folder of the car's launch.

    Attributes:
        commands: Commands of the policy as they came to the car: when heard, when published, both monotonic [ns].
        reasons: What the safety node said, as the car heard it: when [monotonic ns], whether armed, why not.
        offset_s: The workstation's clock against the car's, as the car measured it last [s]; None before.
    """

    def __init__(self, workstation: Path, car: Path) -> None:
        super().__init__(workstation, NODES)
        self.car = car
        self.commands: list[tuple[int, int]] = []
        self.reasons: list[tuple[int, bool, str]] = []
        self.offset_s: float | None = None
        self._ear = Bus(car)
        for topic in ("/policy/drive", "/safety/state", "/clock/offset"):
            self._ear.subscribe(topic)

    def watch(self, duration_s: float = 0.0) -> None:
        """Look at what comes, at both ends."""
        deadline = time.monotonic() + duration_s
        while True:
            super().watch(max(0.0, min(0.02, deadline - time.monotonic())))
            self._listen()
            if time.monotonic() >= deadline:
                return

    def _listen(self) -> None:
        for received in self._ear.receive():
            info = received.info
            if received.topic == "/policy/drive":
                self.commands.append((info.receive_mono_ns, info.publish_mono_ns))
                continue
            message = received.message()
            if received.topic == "/clock/offset":
                self.offset_s = float(message.offset_s)
            else:
                self.reasons.append((info.publish_mono_ns, bool(message.armed), str(message.reason)))

    @property
    def armed(self) -> bool:
        """What the safety node says, at the car."""
        return bool(self.reasons) and self.reasons[-1][1]

    def close(self) -> None:
        """Leave."""
        self.bus.close()
        self._ear.close()


class HostPair:
    """Both hosts at work. Close it.

    Args:
        cable: The cable between them, laid already.
        folder: For run folders, keys and logs.
        policy: The policy file.
        environment: Added to that of the workstation's processes.
        settings: More overrides of the launch file, for both.
    """

    def __init__(
        self,
        cable: Cable,
        folder: Path,
        policy: Path,
        environment: Mapping[str, str] | None = None,
        settings: Sequence[str] = (),
    ) -> None:
        self.cable, self.folder = cable, folder
        self.car, self.desk = folder / ROBOT, folder / WORKSTATION
        for host in (self.car, self.desk):
            host.mkdir()
        self.log = (folder / "hosts.log").open("ab")
        self._processes: list[subprocess.Popen[bytes]] = []
        self.person: Person | None = None
        keys = exchange_keys(folder)
        config = self.car / "twin.yaml"
        config.write_text(json.dumps({"vesc": CONFIGURED, "vicon": {"port": _VICON_PORT}}), encoding="utf-8")
        try:
            self._start(0, {}, "nodes.twin", "--config", str(config), "--folder", str(self.car))
            common = (*self._settings(policy), *settings)
            self._launch(0, ROBOT, self.car, {}, (*common, f"keys={keys[ROBOT]}"))
            self._launch(1, WORKSTATION, self.desk, environment or {}, (*common, f"keys={keys[WORKSTATION]}"))
            self.person = Person(self.desk, self.car)
            self.person.wait_ready(timeout_s=90.0)
        except BaseException:
            self.close()
            raise

    def _settings(self, policy: Path) -> tuple[str, ...]:
        return (
            "record=false",
            f"params.robot={ADDRESSES[0]}",
            f"params.calibration={REPOSITORY / 'calibration' / 'twin'}",
            f"params.policy={policy.resolve()}",
            f"params.vicon_port={_VICON_PORT}",
            f"params.camera={{kind: socket, path: {bus_folder(self.car) / 'frames'}}}",
            f"params.vesc={self.car / 'vesc'}",
        )

    def _launch(
        self, host: int, name: str, folder: Path, environment: Mapping[str, str], settings: Sequence[str]
    ) -> None:
        overrides = [part for setting in settings for part in ("--set", setting)]
        arguments = ("launch", str(LAUNCH_FILE), "--host", name, "--folder", str(folder), *overrides)
        self._start(host, environment, "nodes.cli", *arguments)

    def _start(self, host: int, environment: Mapping[str, str], module: str, *arguments: str) -> None:
        command = [*self.cable.inside(host), sys.executable, "-m", module, *arguments]
        self._processes.append(
            subprocess.Popen(
                command, cwd=REPOSITORY, stdout=self.log, stderr=self.log, env={**os.environ, **environment}
            )
        )

    def wire_size(self) -> int:
        """Length of the wire's log [bytes]."""
        return (self.car / "vesc_wire.csv").stat().st_size

    def wire(self, offset: int = 0) -> list[Any]:
        """What the controller read since the log was so long."""
        return read_wire_log(self.car / "vesc_wire.csv", offset)

    def close(self) -> None:
        """End everything, the lab last."""
        if self.person is not None:
            self.person.close()
        for process in reversed(self._processes):
            end(process)
        self.log.close()


def exchange_keys(folder: Path) -> dict[str, Path]:
    """A key folder for each host, as docs/two_hosts.md says."""
    folders = {name: KeyFolder(folder / f"{name}_keys") for name in (ROBOT, WORKSTATION)}
    public = {name: keys.new(name) for name, keys in folders.items()}
    folders[ROBOT].add(WORKSTATION, public[WORKSTATION])
    folders[ROBOT].allow(WORKSTATION, DRIVE)
    folders[WORKSTATION].add(ROBOT, public[ROBOT])
    return {name: keys.path for name, keys in folders.items()}


def stop_of(rows: Sequence[Any], commands: Sequence[tuple[int, int]]) -> dict[str, Any] | None:
    """How the car was stopped after it had been driven, from its wire's log; None if it still drives, or never did.

    Args:
        rows: What the controller read since somebody armed: event, speed [m/s], odometer [m].
        commands: When commands were heard at the car and when they had been published [monotonic ns].

    Raises:
        BrokenPromise: It was told to move, or moved, after it had been stopped, or it still rolls.
    """
    first = next((index for index, row in enumerate(rows) if row[0].name == "SET_RPM"), None)
    if first is None:
        return None
    stop = next((index for index in range(first, len(rows)) if rows[index][0].name in STOPS), None)
    if stop is None:
        return None
    stop_ns, after = rows[stop][0].mono_ns, rows[stop + 1 :]
    if moves := [row[0] for row in after if row[0].name in MOVES]:
        raise BrokenPromise(
            f"{len(moves)} commands to move came after it was stopped, the first of them {moves[0]}"
        )
    fresh = [sent for heard, sent in commands if heard <= stop_ns and heard - sent <= _FRESH_NS]
    if not fresh:
        raise BrokenPromise("it drove, and no command from the policy was heard")
    rolled = next((row for row in rows[first:] if row[0].mono_ns >= fresh[-1]), rows[stop])[2]
    standing = next((row for row in after if row[0].name == "STANDSTILL"), None)
    if standing is None:
        raise BrokenPromise(
            f"it still rolls {(rows[-1][0].mono_ns - stop_ns) / 1e6:.0f} ms after it was told to stop"
        )
    return {
        "by": rows[stop][0].name,
        "brake_ms": (stop_ns - fresh[-1]) / 1e6,
        "brake_mono_ns": stop_ns,
        "distance_m": standing[2] - rolled,
    }
