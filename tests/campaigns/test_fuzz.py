"""Does anything that comes from outside break a reader? About twenty minutes for 10^6 inputs.

Good inputs are damaged - bits flipped, bytes set to extremes, pieces cut, doubled, swapped, inserted - and random bytes are thrown
in between. A reader may accept an input or refuse it with one of our own errors; any other exception is a crash, more than
two seconds for one input is a hang, and the address space is capped, so that a length field cannot ask for gigabytes.
"""

from __future__ import annotations

import random
import resource
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

from advnerf_core.documents import parse_yaml
from advnerf_core.errors import AdvnerfError
from advnerf_core.strict import validate
from hardware.mocap.vicon_codec import decode_block, encode_blocks, object_pose
from hardware.motor.vesc_codec import FrameDecoder, decode_command, encode_frame
from hardware.motor.vesc_replies import decode_firmware_version, decode_values
from nodes.bags.reader import read_info, read_messages
from nodes.bags.writer import BagWriter
from nodes.launching.launch_schema import LaunchFile
from nodes.runtime.image_parts import join_image, split_image
from nodes.runtime.messages import (
    decode,
    drive_message,
    encode,
    image_message,
    pose_message,
    type_hash_prefix,
)
from nodes.runtime.topics import topic
from nodes.runtime.wire import Meta, pack_meta, unpack
from tests.campaigns.campaign import Campaign
from tests.support.damaged_bytes import mutate
from tests.support.log_damage import LogFiles
from tests.support.scan_damage import ScanFiles

SHARES = {
    "vesc": 300_000,
    "vicon": 250_000,
    "bus": 320_000,
    "config": 40_000,
    "attack": 80_000,
    "bag": 10_000,
    "scan": 40_000,
    "splat": 40_000,
    "log": 20_000,
}
_INPUT_LIMIT_S = 2
_GROWTH_LIMIT_MIB = 50.0  # of one reader, from its first inputs to its last: imports are no growth
_WARM = 500
_HEADROOM_BYTES = 2 * 2**30
_REFUSALS = (AdvnerfError,)


class Hang(BaseException):
    """One input took too long; not an `Exception`, so that no reader swallows it."""


@dataclass(frozen=True)
class Outcome:
    """What became of the inputs of one reader."""

    inputs: int
    refused: int
    worst_s: float
    grown_mib: float


def vesc_reader() -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """Frames off the serial line and what they carry, in one decoder for all inputs as on a real line."""
    decoder = FrameDecoder()
    bodies = [bytes([4]) + bytes(range(n)) for n in (20, 55, 60, 73)] + [
        b"\x00\x06\x05CAR\0" + bytes(12) + b"\0"
    ]
    readers = (decode_values, decode_firmware_version, decode_command)

    def read(data: bytes) -> None:
        payloads = decoder.feed(data) + decoder.give_up()
        if len(decoder._buffer) > 4096:
            raise RuntimeError("the decoder keeps more than the longest frame")
        for payload in (*payloads, data):
            for reader in readers:
                try:
                    reader(payload)
                except _REFUSALS:
                    continue

    return [encode_frame(body) for body in bodies] + bodies, read


def vicon_reader() -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """Datagrams of the motion capture."""
    poses = [object_pose(name, np.eye(4)) for name in ("car", "board", "monitor")]
    good = [encode_blocks(7, poses[:count])[0] for count in (0, 1, 3)]
    return [g[:300] for g in good] + good, lambda data: void(decode_block(data))


def bus_reader() -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """Meta and CDR of three topics; the first byte says which, the second how the frames are cut."""
    names = ("/policy/drive", "/vicon/car", "/camera/image_raw")
    image = image_message(np.zeros((100, 100, 3), np.uint8), 1, "camera")
    messages = (drive_message(0.5, 0.1, 1), pose_message(np.eye(4), 1), image)
    good = []
    for index, (name, message) in enumerate(zip(names, messages, strict=True)):
        meta = pack_meta(Meta(1, 2, 3, type_hash_prefix(topic(name).type), 4))
        good.append(bytes([index, len(meta)]) + meta + encode(message))
    prefix = split_image(image)
    assert prefix is not None

    def read(data: bytes) -> None:
        index, cut = (data[0] % 3, data[1]) if len(data) > 1 else (0, 0)
        _, cdr = unpack(names[index], [names[index].encode(), data[2 : 2 + cut], data[2 + cut :]])
        try:
            decode(topic(names[index]).type, cdr)
        finally:
            if index == 2:
                join_image(cdr[: len(prefix[0])], cdr[len(prefix[0]) :])

    return good, read


def config_reader() -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """A launch file as text."""
    good = (
        b"name: pair\nhosts: {robot: {address: 10.0.0.2}, desk: {}}\nparams: {a: 1, b: [x, y]}\nnodes:\n  camera:\n"
        b"    module: nodes.camera\n    host: robot\n    config: {rate_hz: 10.0}\n  vicon: {module: nodes.vicon, if: true}\n"
    )

    def read(data: bytes) -> None:
        validate(LaunchFile, parse_yaml(data.decode("utf-8", "replace"), "fuzz"))

    return [good], read


def attack_reader(folder: Path) -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """An attack file's bytes: container, header and tensors."""
    from advnerf_core.attack.artifact import attack_from_bytes, face_texture, save_attack
    from tests.support.faces import face_attack

    theta = np.zeros((2, 2, 3), np.float32)
    corners = np.array([[0.0, 0.4, 0.4], [0.0, -0.4, 0.4], [0.0, -0.4, -0.4], [0.0, 0.4, -0.4]])
    attack = face_attack(
        method="gradient",
        theta=theta,
        texture=face_texture(theta, 4),
        size_m=(0.8, 0.8),
        T_world_from_object=np.eye(4),
        subject="board",
        corners_in_subject=corners,
        scene_sha256="a" * 64,
        policy_sha256="b" * 64,
        config_sha256="c" * 64,
        seed=3,
        predicted_total_cte_m=9.25,
        software_version="0.1.0",
    )
    path = folder / "good.attack.safetensors"
    save_attack(path, attack)
    return [path.read_bytes()], lambda data: void(attack_from_bytes(data, "fuzz"))


def bag_reader(folder: Path) -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """A small bag, read whole."""
    good, bad = folder / "good.mcap", folder / "bad.mcap"
    with BagWriter(good) as writer:
        for i in range(20):
            writer.write("/vicon/car", encode(pose_message(np.eye(4), i)), i, i, i)
    path = good if good.is_file() else next(good.rglob("*.mcap"))

    def read(data: bytes) -> None:
        bad.write_bytes(data)
        read_info(bad)
        for _ in read_messages(bad):
            pass

    return [path.read_bytes()], read


def scan_reader(folder: Path) -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """Files of scans of every format."""
    files = ScanFiles(folder / "scans")
    return files.good, files.read


def log_reader(folder: Path) -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """Files of logs of every format."""
    files = LogFiles(folder / "logs")
    return files.good, files.read


def splat_reader(folder: Path) -> tuple[Sequence[bytes], Callable[[bytes], None]]:
    """Splats of every format; the first byte says which."""
    from advnerf_core.splats.reading import read_splats
    from tests.support.splats import sample_files

    files = sample_files(folder)
    suffixes = list(files)

    def read(data: bytes) -> None:
        path = folder / f"damaged.{suffixes[data[0] % len(suffixes) if data else 0]}"
        path.write_bytes(data[1:])
        read_splats(path)

    return [bytes([n]) + files[suffix] for n, suffix in enumerate(suffixes)], read


def void(result: object) -> None:
    """Nothing: only whether it comes back counts."""
    del result


def run(name: str, count: int, seed: int, folder: Path) -> Outcome:
    """Feed one reader; raises on the first crash or hang, with the seed and the input in the message."""
    makers = {
        "vesc": vesc_reader,
        "vicon": vicon_reader,
        "bus": bus_reader,
        "config": config_reader,
        "attack": lambda: attack_reader(folder),
        "bag": lambda: bag_reader(folder),
        "scan": lambda: scan_reader(folder),
        "splat": lambda: splat_reader(folder),
        "log": lambda: log_reader(folder),
    }
    good, read = makers[name]()
    for data in good:  # a reader that refuses everything would be tested by nothing
        read(data)
    random_ = random.Random(f"{name} {seed}")
    refused, worst_s, before_mib = 0, 0.0, resident_mib()
    for index in range(count):
        if index == _WARM:  # modules and tables of the first refusals are there
            before_mib = resident_mib()
        data = mutate(random_, random_.choice(good))
        began = time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, _INPUT_LIMIT_S)
        try:
            read(data)
        except _REFUSALS:
            refused += 1
        except (Exception, Hang) as error:
            signal.setitimer(signal.ITIMER_REAL, 0)
            kept = Path(f"fuzz-{name}-{seed}-{index}.bin")
            kept.write_bytes(data)
            raise RuntimeError(
                f"{name}: input {index} of seed {seed}, kept in {kept}: {type(error).__name__}: {error}"
            ) from error
        signal.setitimer(signal.ITIMER_REAL, 0)
        worst_s = max(worst_s, time.perf_counter() - began)
    return Outcome(count, refused, worst_s, resident_mib() - before_mib)


def resident_mib() -> float:
    """Memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def cap() -> None:
    """Raise on a hang, and cap the memory of this process, for good."""

    def hang(number: int, frame: FrameType | None) -> None:
        raise Hang(f"more than {_INPUT_LIMIT_S} s")

    signal.signal(signal.SIGALRM, hang)
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(
        resource.RLIMIT_AS, (in_use + _HEADROOM_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1])
    )


@pytest.mark.campaign
@pytest.mark.own_process
@pytest.mark.timeout(7200, method="thread")  # the timer that signals is ours
def test_no_input_crashes_or_hangs_a_reader(campaign: Campaign, tmp_path: Path) -> None:
    full = sum(SHARES.values())
    asked, seed = campaign.size(10_000, full), 0
    total, worst_s, growth_mib = 0, 0.0, 0.0
    cap()
    for name, share in SHARES.items():
        outcome = run(name, share * asked // full, seed, tmp_path)
        total, worst_s = total + outcome.inputs, max(worst_s, outcome.worst_s)
        growth_mib = max(growth_mib, outcome.grown_mib)
        print(
            f"{name}: {outcome.inputs} inputs, {outcome.refused} refused, longest {outcome.worst_s * 1e3:.1f} ms, grown by {outcome.grown_mib:.0f} MiB"
        )
    campaign.record(
        "fuzz: VESC, VICON, bus, config, attack file, bag, scan, splat, log",
        total,
        "inputs",
        "10^6: no crash, hang or memory growth",
        total >= full and growth_mib < _GROWTH_LIMIT_MIB,
        f"seed {seed}; longest input {worst_s * 1e3:.0f} ms; no reader grew by more than {growth_mib:.0f} MiB",
    )
    assert growth_mib < _GROWTH_LIMIT_MIB
