"""What does a decoded message cost over raw bytes? ``python -m benchmarks.one_hop`` (about half a minute).

Two processes play ping-pong over Unix sockets: once with raw pyzmq (one frame, nothing decoded), once with our bus, where each
side decodes what came and publishes a new message. The two alternate in the same run, so that the machine's other work hits both.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import zmq

from benchmarks.results import record_row
from nodes.runtime.bus import Bus
from nodes.runtime.messages import decode, encode, image_message, pose_message, stamp_from_ns
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import topic

COMMAND = "python -m benchmarks.one_hop"
HEIGHT, WIDTH = 188, 366
IMAGE, POSE = "image", "pose"
PING = {IMAGE: "/camera/image_raw", POSE: "/vicon/car"}
PONG = {IMAGE: "/compositor/image", POSE: "/vicon/board"}
TARGETS = {IMAGE: 1.5, POSE: 2.5}
_TIMEOUT_S = 5.0


def payload(kind: str) -> bytes:
    """CDR bytes of the message that is sent."""
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return encode(image_message(pixels, 0, "camera") if kind == IMAGE else pose_message(np.eye(4), 0))


def bus_round_trip(bus: Bus, kind: str) -> Callable[[], float]:
    """A function that plays one round over the bus, decoded at both ends [s]."""
    bus.publisher(PING[kind])
    bus.subscribe(PONG[kind])
    message = decode(topic(PING[kind]).type, payload(kind))

    def play() -> float:
        began = time.perf_counter()
        message.header.stamp = stamp_from_ns(time.time_ns())
        bus.publish(PING[kind], message)
        _take(bus, kind)
        return time.perf_counter() - began

    return play


def _take(bus: Bus, kind: str) -> Any:
    deadline = time.monotonic() + _TIMEOUT_S
    while True:
        bus.wait(_TIMEOUT_S)  # as a node's loop does: sleep first, then look
        for received in bus.receive():
            message = received.message()
            if kind == IMAGE:
                rgb_image(message, IMAGE)
            return message
        if time.monotonic() > deadline:
            raise TimeoutError(f"no answer within {_TIMEOUT_S:g} s")


def answer(folder: Path, kind: str) -> None:
    """The other process: answers raw rounds and rounds over the bus."""
    raw: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PAIR)
    raw.linger = 0
    raw.bind(f"ipc://{folder}/raw.{kind}")
    with Bus(folder) as bus:
        bus.publisher(PONG[kind])
        bus.subscribe(PING[kind])
        while True:
            # One kind of round is answered without a look at the other: each is timed as if it were alone.
            which = raw.recv()
            if which == b"end":
                return
            rounds = int(raw.recv())
            raw.send(b"")
            for _ in range(rounds):
                if which == b"raw":
                    raw.send(raw.recv())
                else:
                    message = _take(bus, kind)
                    message.header.stamp = stamp_from_ns(time.time_ns())
                    bus.publish(PONG[kind], message)


def compare(kind: str, blocks: int, rounds: int) -> tuple[float, float, float]:
    """Median round trips over the bus and raw [s], and the ratio (median of the blocks' ratios)."""
    with tempfile.TemporaryDirectory(prefix="advnerf-hop-") as name, Bus(Path(name)) as bus:
        folder = Path(name)
        command = [sys.executable, "-m", "benchmarks.one_hop", "--answer", kind, "--folder", name]
        other = subprocess.Popen(command)
        control: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PAIR)
        control.linger = 0
        control.rcvtimeo = 20_000
        control.connect(f"ipc://{folder}/raw.{kind}")
        play = {b"raw": _raw_play(control, kind), b"bus": bus_round_trip(bus, kind)}
        bus.wait_for_subscribers([PING[kind]], 20.0)
        times: dict[bytes, list[float]] = {b"raw": [], b"bus": []}
        try:
            for block in range(blocks + 1):
                for which in times:
                    control.send(which)
                    control.send(str(rounds).encode())
                    control.recv()
                    taken = median(play[which]() for _ in range(rounds))
                    if block:  # the first warms up
                        times[which].append(taken)
            control.send(b"end")
            other.wait(10.0)
        finally:
            other.kill()
            other.wait()
            control.close()
    ratio = median(ours / raw for ours, raw in zip(times[b"bus"], times[b"raw"], strict=True))
    return median(times[b"bus"]), median(times[b"raw"]), ratio


def _raw_play(socket: zmq.Socket[bytes], kind: str) -> Callable[[], float]:
    data = payload(kind)

    def play() -> float:
        began = time.perf_counter()
        socket.send(data)
        socket.recv()
        return time.perf_counter() - began

    return play


def main() -> None:
    """Measure both kinds and record the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trial", action="store_true", help="a small run; record nothing")
    parser.add_argument("--answer", choices=(IMAGE, POSE), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.answer:
        answer(options.folder, options.answer)
        return
    for kind, target in TARGETS.items():
        ours, raw, ratio = compare(kind, 3 if options.trial else 15, 200 if options.trial else 500)
        note = (
            f"{ours * 1e6:.0f} us decoded at both ends, {raw * 1e6:.0f} us raw; median of alternating blocks"
        )
        print(f"{kind}: {ratio:.2f} x ({note})")
        if not options.trial:
            size = f" {WIDTH}x{HEIGHT}" if kind == IMAGE else ""
            record_row(
                f"one hop, {kind}{size}, publish to decoded, round trip against raw pyzmq",
                ratio,
                "x",
                f"<= {target:g} x",
                ratio <= target,
                COMMAND,
                note,
            )


if __name__ == "__main__":
    main()
