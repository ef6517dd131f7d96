"""Repairs an unfinished or damaged bag: keeps everything that can be read, and writes the missing end.

The new file is written next to the old one and checked before it takes the old name. The old file is kept under another name. A
repair that would lose more than the damaged end of an unfinished file is refused without ``force``.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, ChunkIndex, Message, Schema

from advnerf_core.files import write_atomically
from nodes.bags.assemble import FileLayout, assemble, contents_of
from nodes.bags.foreign import read_stored
from nodes.bags.formats import BagFormat, recognise, require_mcap
from nodes.bags.journal import RESERVE_BYTES, RESERVE_NAME, journal_of, read_journal
from nodes.bags.metadata import rosbag2_metadata
from nodes.bags.parts import METADATA_FILE
from nodes.bags.scan import fill_anew, scan_file
from nodes.bags.scanned import Piece, Scan
from nodes.runtime.errors import BagError
from nodes.runtime.messages import type_definition, type_hash
from nodes.runtime.topics import topic as topic_row

KEPT_SUFFIX = ".damaged"
_BLOCK_BYTES = 1 << 24
_LOADED_S = 0.5


@dataclass(frozen=True)
class TopicRepair:
    """Number of messages of a topic before and after a repair; before is None if the file does not state it."""

    name: str
    before: int | None
    after: int


@dataclass(frozen=True)
class Repaired:
    """Result of a repair.

    Attributes:
        messages: Number of messages in the repaired file.
        cut_bytes: Number of bytes that could not be kept.
        was_whole: Whether the file was intact, so that it was not changed.
        kept: Path of the damaged file; None if it was removed or the file was not changed.
        topics: Message counts by topic.
        losses: Losses, as text.
        fixes: Repairs without a loss, as text.
        unchecked: Why damage to messages may go unnoticed; empty if checksums cover them.
    """

    path: Path
    messages: int
    cut_bytes: int = 0
    was_whole: bool = False
    kept: Path | None = None
    topics: tuple[TopicRepair, ...] = ()
    losses: tuple[str, ...] = ()
    fixes: tuple[str, ...] = ()
    unchecked: str = ""


def repair(file: Path, force: bool = False, keep_original: bool = True, in_place: bool = False) -> Repaired:
    """Repair a file. An intact file is not changed.

    Args:
        file: One file of a bag.
        force: Repair even if this loses messages that are not at the damaged end of an unfinished file.
        keep_original: Keep the old file, as ``NAME.mcap.damaged``.
        in_place: Write no second file. This only works for an unfinished file whose beginning stays the same, for a recorder on a full disk.

    Raises:
        BagError: The file is not MCAP, is being written, or would lose too much. The file is then unchanged.
    """
    path = file.resolve()
    if (form := recognise(path)) is not BagFormat.MCAP:
        # A damaged one says what rebuilds it, as it cannot be converted.
        read_stored(path, form, path.stat().st_size)
    require_mcap(path, "repaired")
    try:
        before = path.stat()
        # A running recorder would continue to write to the old file.
        if not in_place and being_written(path):
            raise BagError(f"{path} is being written at this moment; stop its recorder first")
        scan = examine(path)
        if scan.whole:
            _complete_folder(path, scan, None)
            return Repaired(path, scan.messages, was_whole=True, unchecked=scan.unchecked)
        known = _messages_before(scan)
        losses = tuple(scan.describe(loss) for loss in scan.losses)
        if not force and (refusal := refusal_of(scan)):
            raise BagError(f"{path} is not repaired, because {refusal}. {_ADVICE}")
        cut = sum(loss.length for loss in scan.losses)
        layout = assemble(scan, path.name, {"cut_bytes": str(cut), "lost": "; ".join(losses)[:10_000]})
        kept = None
        if in_place:
            _extend(path, layout)
        else:
            kept = _swap(path, layout, scan, before, keep_original)
    except OSError as error:
        raise BagError(f"cannot repair {path}: {error.strerror}; the file is unchanged") from error
    _complete_folder(path, scan, kept)
    after = contents_of(scan).counts
    topics = tuple(
        TopicRepair(name, known.get(name), after.get(name, 0))
        for name in (*sorted(after), *sorted(known.keys() - after.keys()))
    )
    return Repaired(path, scan.messages, cut, False, kept, topics, losses, tuple(scan.fixes), scan.unchecked)


def examine(path: Path) -> Scan:
    """Scan a file, including the messages in its journal."""
    scan = scan_file(path)
    _add_journal(scan, path)
    return scan


_ADVICE = "With --force the rest is kept, and a copy of the damaged file"


def refusal_of(scan: Scan) -> str:
    """Explain why a repair needs ``force``; empty if it only loses the end of an unfinished file."""
    more = scan.loses_more_than_the_tail()
    if more:
        rest = f", and {len(more) - 1} more places" if len(more) > 1 else ""
        return f"messages would be lost that are not at the end of an unfinished recording: {scan.describe(more[0])}{rest}"
    listed = scan.known.statistics if scan.known is not None else None
    if listed is not None and listed.message_count > scan.messages:
        return f"its summary lists {listed.message_count} messages, but {scan.messages} were found"
    if scan.data_crc_wrong and scan.unchecked_messages + scan.unchecked_chunks:
        return (
            "the checksum of all its data is wrong, and the damaged messages cannot be identified; "
            "the repaired file would have all messages, unchecked"
        )
    if not scan.messages and scan.losses:
        return f"no message of its {scan.size} bytes would be left: {scan.describe(scan.losses[0])}"
    return ""


def _messages_before(scan: Scan) -> dict[str, int]:
    """Number of messages by topic according to the summary, or as far as known without one."""
    known = scan.known
    counts: dict[str, int] = {}
    if known is not None and known.statistics is not None and known.channels:
        for channel_id, count in known.statistics.channel_message_counts.items():
            if channel_id in known.channels:
                name = known.channels[channel_id].topic
                counts[name] = counts.get(name, 0) + count
        return counts
    if any(loss.kind != "cut" and not loss.counts and not loss.harmless for loss in scan.losses):
        return {}
    for lost in (scan.counts, *(loss.counts for loss in scan.losses)):
        for channel_id, count in lost.items():
            if channel_id in scan.channels:
                name = scan.channels[channel_id].topic
                counts[name] = counts.get(name, 0) + count
    return counts


def being_written(path: Path) -> bool:
    """Whether a process has the file open for writing. The system grants a read lease only if no process has."""
    # A process that was started while a file was open has it too until its own program is loaded: that is no writer.
    until_s = time.monotonic() + _LOADED_S
    with open(path, "rb") as file:
        while True:
            try:
                fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
                fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_UNLCK)
            except BlockingIOError:
                if time.monotonic() > until_s:
                    return True
                time.sleep(0.01)
            except OSError:
                return False  # a file system without leases, or a file of another user
            else:
                return False


def _swap(
    path: Path, layout: FileLayout, scan: Scan, before: os.stat_result, keep_original: bool
) -> Path | None:
    """Write the new file, check it, and rename it. The old file is complete under one of its names at every moment."""
    temporary = path.with_name(f".{path.name}.repair")
    try:
        with open(path, "rb") as old, open(temporary, "wb") as new:
            for part in layout.parts:
                _copy(old, new, part)
            new.flush()
            os.fsync(new.fileno())
        shutil.copymode(path, temporary)
        check = scan_file(temporary)
        if not check.whole or check.counts != {i: n for i, n in scan.counts.items() if n}:
            raise BagError(
                f"{path} could not be repaired: the new file does not have the expected contents; the old file is unchanged"
            )
        now = path.stat()
        if (now.st_size, now.st_mtime_ns, now.st_ino) != (before.st_size, before.st_mtime_ns, before.st_ino):
            raise BagError(
                f"{path} changed while it was being repaired, so it was not repaired; stop the program that writes it"
            )
        kept = _keep(path) if keep_original else None
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)
    return kept


def _copy(old: Any, new: Any, part: range | bytes) -> None:
    if isinstance(part, bytes):
        new.write(part)
        return
    new.flush()
    old.seek(part.start)
    left = len(part)
    while left:
        block = old.read(min(left, _BLOCK_BYTES))
        if not block:
            raise BagError("the file became shorter while it was being repaired")
        new.write(block)
        left -= len(block)


def kept_names(path: Path) -> Iterator[Path]:
    """Names for the damaged file that are not in use."""
    yield path.with_name(path.name + KEPT_SUFFIX)
    number = 2
    while True:
        yield path.with_name(f"{path.name}{KEPT_SUFFIX}.{number}")
        number += 1


def _keep(path: Path) -> Path:
    """Create a second name for the old file."""
    for name in kept_names(path):
        try:
            os.link(path, name)
        except FileExistsError:
            if name.samefile(path):  # from a repair that was stopped at this point
                return name
        except OSError:  # a file system without links
            if not os.path.lexists(name):
                path.rename(name)
                return name
        else:
            return name
    raise AssertionError("unreachable")


def _extend(path: Path, layout: FileLayout) -> None:
    """Truncate the file after the unchanged part and append the rest."""
    unchanged = layout.unchanged
    rest, at = [], 0
    for part in layout.parts:
        if at >= unchanged:
            if isinstance(part, range):
                raise BagError(f"{path} is damaged in the middle; repair it with: advnerf bag repair {path}")
            rest.append(part)
        at += len(part)
    with open(path, "r+b") as file:
        file.truncate(unchanged)
        file.seek(unchanged)
        for content in rest:
            file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _complete_folder(path: Path, scan: Scan, kept: Path | None) -> None:
    """Write a missing ``metadata.yaml`` and remove files that the recorder left."""
    reserve, journal = path.with_name(RESERVE_NAME), journal_of(path)
    if reserve.exists() and reserve.stat().st_size == RESERVE_BYTES:
        reserve.unlink()
    if journal.exists():
        if kept is not None:
            journal.replace(kept.with_name(kept.name + ".journal"))
        else:
            journal.unlink()
    yaml = path.with_name(METADATA_FILE)
    alone = [file for file in path.parent.glob("*.mcap") if file.is_file()] == [path]
    if alone and not yaml.exists():
        write_atomically(yaml, rosbag2_metadata({path.name: contents_of(scan)}))


def _add_journal(scan: Scan, path: Path) -> None:
    """Add the messages of the journal as one more chunk."""
    position, entries = read_journal(path)
    chunks = [piece for piece in scan.pieces if isinstance(piece.record, ChunkIndex)]
    # A chunk after that position already has these messages: the recorder or an earlier repair ended before it emptied the journal.
    if not entries or scan.data_end is not None or any(piece.offset >= position for piece in chunks):
        return
    builder = RecordBuilder()
    ids = {channel.topic: channel.id for channel in scan.channels.values()}
    indexes: dict[int, list[tuple[int, int]]] = {}
    for entry in entries:
        if entry.topic not in ids:
            ids[entry.topic] = _introduce(builder, scan, entry.topic, max(ids.values(), default=0) + 1)
        channel_id = ids[entry.topic]
        indexes.setdefault(channel_id, []).append((entry.log_ns, builder.count))
        Message(channel_id, entry.log_ns, entry.cdr, entry.publish_ns, entry.sequence).write(builder)
        scan.count(channel_id, entry.sequence, entry.log_ns)
    data, times = bytes(builder.end()), [entry.log_ns for entry in entries]
    piece = Piece(0, 0)
    fill_anew(piece, data, (min(times), max(times)), zlib.crc32(data), indexes)
    scan.pieces.append(piece)


def _introduce(builder: RecordBuilder, scan: Scan, topic: str, channel_id: int) -> int:
    """Write schema and channel of a topic whose first message is in the journal."""
    typename = topic_row(topic).type
    known = {schema.name: schema.id for schema in scan.schemas.values()}
    if typename not in known:
        schema = Schema(
            max(scan.schemas, default=0) + 1, type_definition(typename).encode(), "ros2msg", typename
        )
        scan.schemas[schema.id] = schema
        schema.write(builder)
        known[typename] = schema.id
    channel = Channel(channel_id, topic, "cdr", {"topic_type_hash": type_hash(typename)}, known[typename])
    scan.channels[channel_id] = channel
    channel.write(builder)
    return channel_id
