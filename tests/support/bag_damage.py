"""Does damage to a bag change a number without a word? For the campaign, and for the tests of readers and repair.

Small bags of every kind - ours, in chunks with each compression, without chunks, both mixed - are cut off at random places and
repaired: what is kept must be what an independent reader finds in front of the cut, and the cut file must still be there, byte for
byte. Then single bits are flipped in the bytes that a checksum covers: every reader must give the same numbers as before, or an error;
and what a repair keeps of the file must all be true.
"""

from __future__ import annotations

import random
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.repair import repair
from nodes.bags.writer import BagWriter
from nodes.runtime.errors import BagError
from nodes.runtime.messages import encode, pose_message, type_definition

START_NS = 1_800_000_000_000_000_000
_POSE = "geometry_msgs/msg/PoseStamped"
_ATTACHED = b"speed_mps: 0.8\n" * 20
Message = tuple[str, int, int, int, bytes]


class SilentDamage(RuntimeError):
    """A bag was damaged, and a number changed or a message vanished without an error."""


def reachable(content: bytes) -> list[Message]:
    """Topic, log time, publish time, sequence and data of every message in front of the first record that is not whole.

    This reader shares no code with the others: it goes by the specification of the format alone.
    """
    topics: dict[int, str] = {}
    found: list[Message] = []

    def walk(data: bytes, at: int) -> None:
        while at + 9 <= len(data):
            opcode, length = struct.unpack_from("<BQ", data, at)
            body = data[at + 9 : at + 9 + length]
            if opcode == 0x0F or len(body) < length:
                return
            if opcode == 0x04:
                channel, _, name_length = struct.unpack_from("<HHI", body)
                topics[channel] = body[8 : 8 + name_length].decode()
            elif opcode == 0x05:
                channel, sequence, log_ns, publish_ns = struct.unpack_from("<HIQQ", body)
                found.append((topics[channel], log_ns, publish_ns, sequence, body[22:]))
            elif opcode == 0x06:
                size, crc, name_length = struct.unpack_from("<QII", body, 16)
                name, packed = body[32 : 32 + name_length], body[40 + name_length :]
                if name == b"lz4":
                    packed = lz4.frame.decompress(packed)
                elif name == b"zstd":
                    packed = zstandard.decompress(packed, size)
                if crc and zlib.crc32(packed) != crc:
                    return
                walk(packed, 0)
            at += 9 + length

    walk(content, 8)
    return found


def covered(content: bytes) -> list[range]:
    """Bytes that a checksum covers: records in chunks, attachments, the summary, and everything if there is one for all data."""
    ranges, at = [], 8
    while True:
        opcode, length = struct.unpack_from("<BQ", content, at)
        body = at + 9
        if opcode == 0x06 and content[body + 24 : body + 28] != b"\0\0\0\0":
            (name_length,) = struct.unpack_from("<I", content, body + 28)
            ranges.append(range(body + 40 + name_length, body + length))
        elif opcode == 0x09:
            ranges.append(range(body, body + length))
        elif opcode == 0x0F:
            if content[body : body + 4] != b"\0\0\0\0":
                ranges = [range(at)]
            break
        at = body + length
    if content[-12:-8] != b"\0\0\0\0":
        ranges.append(range(body + length, len(content) - 12))
    return ranges


def _ours(path: Path) -> None:
    folder = path.parent / path.stem
    with BagWriter(folder, {"a.yaml": _ATTACHED}, {"git": "abc"}) as writer:
        for index, (topic, data, stamp_ns) in enumerate(_messages()):
            writer.write(topic, data, stamp_ns, stamp_ns - 1000, index)
            if index % 12 == 11:
                writer.flush()
        file = writer.path
    file.rename(path)


def _theirs(
    compression: CompressionType = CompressionType.NONE,
    chunks: bool = True,
    crcs: bool = True,
    all_data: bool = False,
) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with open(path, "wb") as file:
            writer = Writer(
                file,
                chunk_size=2000,
                compression=compression,
                use_chunking=chunks,
                enable_crcs=crcs,
                enable_data_crcs=all_data,
            )
            _fill(writer)

    return write


def _mixed(path: Path) -> None:
    """A file with messages in chunks and outside: made of one with chunks, whose second half is taken out of them."""
    _theirs()(path)
    content, at, kept, chunks = path.read_bytes(), 8, b"", 0
    while content[at] != 0x0F:
        (length,) = struct.unpack_from("<Q", content, at + 1)
        record = content[at : at + 9 + length]
        chunks += record[0] == 0x06
        if chunks > 2 and record[0] == 0x06:
            record = record[9 + 40 :]
        elif chunks > 2 and record[0] == 0x07:
            record = b""
        kept, at = kept + record, at + 9 + length
    footer = struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)
    path.write_bytes(content[:8] + kept + content[at : at + 13] + footer + content[:8])


def _fill(writer: Writer) -> None:
    writer.start(profile="ros2", library="somebody")
    schema = writer.register_schema(_POSE, "ros2msg", type_definition(_POSE).encode())
    channels: dict[str, int] = {}
    for index, (topic, data, stamp_ns) in enumerate(_messages()):
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic], stamp_ns, data, stamp_ns - 1000, index)
        if index == 30:
            writer.add_attachment(START_NS, START_NS, "a.yaml", "text/yaml", _ATTACHED)
    writer.finish()


def _messages() -> list[tuple[str, bytes, int]]:
    rows = []
    for index in range(60):
        T = np.eye(4)
        T[:2, 3] = 0.08 * index, 0.3 * np.sin(index)
        stamp_ns = START_NS + index * 20_000_000
        rows.append(
            (("/vicon/car", "/vicon/board")[index % 3 == 2], encode(pose_message(T, stamp_ns)), stamp_ns)
        )
    return rows


KINDS: dict[str, Callable[[Path], None]] = {
    "ours": _ours,
    "chunks": _theirs(),
    "lz4": _theirs(CompressionType.LZ4),
    "zstd": _theirs(CompressionType.ZSTD),
    "no chunks": _theirs(chunks=False),
    "mixed": _mixed,
    "no checksums": _theirs(CompressionType.ZSTD, crcs=False),
    "all data": _theirs(chunks=False, all_data=True),
}  # fmt: skip
# With a checksum over their messages.
COVERED = ("ours", "chunks", "lz4", "zstd", "all data")


@dataclass(frozen=True)
class Numbers:
    """What readers find in a bag."""

    counts: dict[str, int]
    span_ns: tuple[int, int]
    messages: list[Message]
    attachments: dict[str, bytes]

    @classmethod
    def of(cls, path: Path) -> Numbers:
        """Read all there is."""
        info = read_info(path)
        counts = {topic.name: topic.count for topic in info.topics}
        return cls(counts, (info.start_ns, info.end_ns), messages_of(path), read_attachments(path))


def messages_of(path: Path) -> list[Message]:
    """Messages as our reader gives them."""
    return [
        (m.topic, m.log_ns, m.publish_ns, m.sequence, m.cdr) for m in read_messages(path, as_recorded=True)
    ]


def make_bags(folder: Path) -> dict[str, bytes]:
    """One small file of every kind."""
    contents = {}
    for name, write in KINDS.items():
        path = folder / f"{name}.mcap"
        write(path)
        contents[name] = path.read_bytes()
    return contents


def cut_once(content: bytes, length: int, folder: Path, number: int) -> int:
    """Cut a file, repair it, compare; how many messages were kept."""
    path = folder / f"cut{number}" / "bag.mcap"
    path.parent.mkdir()
    cut = content[:length]
    path.write_bytes(cut)
    expected = reachable(cut)
    try:
        done = repair(path)
    except BagError as error:
        # A file of which no message is left is not replaced by one without any.
        if expected or path.read_bytes() != cut:
            raise SilentDamage(
                f"cut to {length} bytes, {len(expected)} messages, refused: {error}"
            ) from error
        return 0
    before = path if done.was_whole else done.kept
    if before is None or before.read_bytes() != cut:
        raise SilentDamage(f"cut to {length} bytes: the file is not there any more as it was")
    if (
        reachable(path.read_bytes()) != expected
        or messages_of(path) != expected
        or not repair(path).was_whole
    ):
        raise SilentDamage(f"cut to {length} bytes: expected {len(expected)} messages, kept {done.messages}")
    return done.messages


def flip_once(
    content: bytes, at: int, bit: int, good: Numbers, folder: Path, number: int
) -> tuple[bool, int]:
    """Flip a bit, read, repair; whether a reader noticed, and how many messages the repair kept."""
    path = folder / f"flip{number}" / "bag.mcap"
    path.parent.mkdir()
    damaged = bytearray(content)
    damaged[at] ^= 1 << bit
    path.write_bytes(damaged)
    try:
        found = Numbers.of(path)
    except BagError:
        noticed = True
    else:
        noticed = False
        if found != good:
            raise SilentDamage(f"bit {bit} of byte {at}: other numbers, and no error")
    true = set(good.messages)
    try:
        done = repair(path)
    except BagError:
        done = repair(path, force=True)
    kept = messages_of(path)
    if done.unchecked == "" and not true.issuperset(kept):
        raise SilentDamage(f"bit {bit} of byte {at}: the repair keeps a message that never was")
    if done.kept is not None and done.kept.read_bytes() != damaged:
        raise SilentDamage(f"bit {bit} of byte {at}: the file is not there any more as it was")
    return noticed, len(kept)


def cuts(count: int, seed: int) -> str:
    """Cut bags of all kinds; a note on what was kept."""
    draw, kept = random.Random(f"cuts {seed}"), 0
    with tempfile.TemporaryDirectory(prefix="advnerf-", dir=_fast()) as name:
        folder = Path(name)
        bags = make_bags(folder)
        for number in range(count):
            kind = draw.choice(list(bags))
            try:
                kept += cut_once(bags[kind], draw.randrange(8, len(bags[kind])), folder, number)
            except SilentDamage as error:
                raise SilentDamage(f"{kind}, cut {number} of seed {seed}: {error}") from error
            _forget(folder / f"cut{number}")
    return f"{kept} messages kept, by {len(KINDS)} kinds of files: {', '.join(KINDS)}"


def flips(count: int, seed: int) -> str:
    """Flip bits; a note on what was noticed."""
    draw, noticed, kept, whole = random.Random(f"flips {seed}"), 0, 0, 0
    with tempfile.TemporaryDirectory(prefix="advnerf-", dir=_fast()) as name:
        folder = Path(name)
        bags = {kind: content for kind, content in make_bags(folder).items() if kind in COVERED}
        good = {kind: Numbers.of(folder / f"{kind}.mcap") for kind in bags}
        places = {kind: [at for part in covered(content) for at in part] for kind, content in bags.items()}
        for number in range(count):
            kind = draw.choice(list(bags))
            at, bit = draw.choice(places[kind]), draw.randrange(8)
            try:
                seen, left = flip_once(bags[kind], at, bit, good[kind], folder, number)
            except SilentDamage as error:
                raise SilentDamage(f"{kind}, flip {number} of seed {seed}: {error}") from error
            noticed, kept, whole = noticed + seen, kept + left, whole + len(good[kind].messages)
            _forget(folder / f"flip{number}")
    return f"{noticed} ended in an error, {count - noticed} changed nothing that is read; repair kept {100 * kept / whole:.1f} % of the messages"


def _forget(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()


def _fast() -> str | None:
    """Memory, where there is some to write to: thousands of small files are synced."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None
