"""Can anybody but the workstation move the car? About 20 s.

The real gateway of the car runs as a process, with keys. Strangers come to its drive door: without a key, with a key nobody knows,
with a key that may only watch, and an allowed key that sends malformed and oversized messages. Each says "drive" and "arm" for
two seconds; what reaches the car's bus is counted, and so is what the gateway says about it. An honest workstation comes before
and after them: a door that lets nobody in would prove nothing.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zmq

from nodes.linking.keys import DRIVE, WATCH, KeyFolder
from nodes.runtime.bus import Bus
from nodes.runtime.messages import drive_message, encode, header, type_hash_prefix, types
from nodes.runtime.topics import topic
from nodes.runtime.wire import Meta, pack_meta
from tests.campaigns.campaign import Campaign
from tests.support.live.processes import REPOSITORY, free_ports

_TRY_S, _HONEST_S = 2.0, 15.0
_COMMANDS = ("/policy/drive", "/arm")
_OVERSIZED_BYTES = 20 * 2**20


@dataclass
class Car:
    """The car's gateway at work."""

    folder: Path
    keys: KeyFolder
    port: int
    bus: Bus
    process: subprocess.Popen[bytes]
    public: str = ""
    heard: list[str] = field(default_factory=list)

    @property
    def log(self) -> str:
        """What the gateway said so far."""
        return (self.folder / "gateway.log").read_text()


def start_car(folder: Path) -> Car:
    """Keys, allow-lists and the gateway process."""
    keys = KeyFolder(folder / "keys")
    public = keys.new("robot")
    for name, right in (("workstation", DRIVE), ("visitor", WATCH)):
        keys.new(name)
        keys.allow(name, right)
    ports = free_ports(2)
    config = folder / "gateway.yaml"
    document = {
        "listen": "127.0.0.1",
        "watch_port": ports[0],
        "drive_port": ports[1],
        "keys": str(keys.path),
        "key": "robot",
        "imports": list(_COMMANDS),
        "exports": ["/vicon/car"],
    }
    config.write_text(json.dumps(document), encoding="utf-8")
    bus = Bus(folder)
    for name in _COMMANDS:
        bus.subscribe(name)
    with open(folder / "gateway.log", "wb") as log:
        command = [sys.executable, "-m", "nodes.gateway", "--config", str(config), "--folder", str(folder)]
        process = subprocess.Popen(command, cwd=REPOSITORY, stderr=log)
    return Car(folder, keys, ports[1], bus, process, public)


def commands() -> list[list[bytes]]:
    """A command to drive and a request to arm, as they travel."""
    now_ns = time.time_ns()
    arm = types.Arm(
        header=header(now_ns), arm=True, source="operator", reason="", ask_id="stranger", age_ns=0
    )
    found = []
    for name, message in zip(_COMMANDS, (drive_message(0.8, 0.0, now_ns), arm), strict=True):
        meta = Meta(time.monotonic_ns(), now_ns, 0, type_hash_prefix(topic(name).type), 1)
        found.append([name.encode(), pack_meta(meta), encode(message)])
    return found


def malformed() -> list[list[bytes]]:
    """What an allowed key sends when its computer is broken or not its own any more."""
    (name, meta, cdr), _ = commands()
    wrong_type = pack_meta(Meta(0, 0, 0, b"\0" * 8, 1))
    return [
        [name],
        [name, meta],
        [name, b"", cdr],
        [name, meta, cdr[:-1]],
        [name, meta, b"\xff" * len(cdr)],
        [name, wrong_type, cdr],
        [name, meta, bytes(2**20)],
        [name, meta, bytes(_OVERSIZED_BYTES)],
        [name, *[b""] * 999],
        [b"/motor/sent", meta, cdr],
        [b"/policy/drive/../../arm", meta, cdr],
        [b"\xff" * 64, meta, cdr],
    ]


def attempt(car: Car, key: str | None, bad: bool = False, patience_s: float = _TRY_S) -> int:
    """Knock at the drive door and talk; how many messages reached the car's bus.

    Args:
        car: The car.
        key: Name of a key of the folder; empty for a key nobody knows, None for none.
        bad: Send malformed messages instead of good commands.
        patience_s: How long; it ends early at the first message that reaches the bus.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    door = context.socket(zmq.PUB)
    door.linger = 0
    if key is not None:
        public, secret = (
            (car.keys.public(key).encode(), car.keys.secret(key).encode()) if key else zmq.curve_keypair()
        )
        door.curve_publickey, door.curve_secretkey, door.curve_serverkey = public, secret, car.public.encode()
    door.connect(f"tcp://127.0.0.1:{car.port}")
    deadline, reached = time.monotonic() + patience_s, 0
    while time.monotonic() < deadline and not reached:
        for frames in malformed() if bad else commands():
            door.send_multipart(frames)
        car.bus.wait(0.05)
        reached += len(car.bus.receive())
        if car.process.poll() is not None:
            raise RuntimeError(f"the gateway ended: {car.log}")
    door.close()
    context.term()
    return reached


@pytest.mark.campaign
def test_only_the_workstation_reaches_the_cars_bus(campaign: Campaign, tmp_path: Path) -> None:
    car = start_car(tmp_path)
    try:
        honest = [attempt(car, "workstation", patience_s=_HONEST_S)]
        car.bus.wait(0.3)
        car.bus.receive()  # the last words of the honest one
        guests = {"no key": None, "unknown key": "", "watch-only key": "visitor"}
        reached = {guest: attempt(car, key) for guest, key in guests.items()}
        reached["malformed and oversized"] = attempt(car, "workstation", bad=True)
        honest.append(attempt(car, "workstation", patience_s=_HONEST_S))
    finally:
        car.bus.close()
        car.process.send_signal(signal.SIGINT)
        car.process.wait(10.0)
    needles = ("it has no CURVE key", "its key", "expected three frames", "expected an imported topic")
    logged = [needle in car.log for needle in needles]
    met = not any(reached.values()) and all(logged) and all(honest)
    campaign.record(
        "strangers: no key, wrong key, watch-only key driving, oversized, malformed",
        sum(reached.values()),
        "messages let in",
        "0: all refused and logged",
        met,
        f"refusals in the log: {sum(logged)} of {len(logged)} kinds; an allowed workstation drives before and after",
    )
    assert met, f"reached the bus: {reached}; logged: {logged}; the honest workstation: {honest}; {car.log}"
