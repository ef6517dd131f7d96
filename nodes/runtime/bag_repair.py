"""Make an unfinished bag whole: cut off what was half written, add the summary that a killed recorder never wrote.

It works in place, because a bag may be larger than what is left on the disk, and it can be run again if it is interrupted.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from advnerf_core.files import write_atomically
from nodes.runtime.bag_file import NONSENSE, BoundedFile
from nodes.runtime.bag_journal import journal_of, read_journal
from nodes.runtime.bag_metadata import Contents, rosbag2_metadata
from nodes.runtime.bag_parts import METADATA_FILE
from nodes.runtime.bag_scan import RECORD_HEAD, Scan, note_chunk, redo_last_index, scan_file
from nodes.runtime.errors import BagError
from nodes.runtime.messages import type_definition, type_hash
from nodes.runtime.topics import topic as topic_row


@dataclass(frozen=True)
class Repaired:
    """What a repair did.

    Attributes:
        path: The file.
        messages: Messages in it.
        cut_bytes: Bytes of half-written records that were cut off.
        was_whole: There was nothing to do.
    """

    path: Path
    messages: int
    cut_bytes: int = 0
    was_whole: bool = False


def mcap_file(bag: Path) -> Path:
    """The ``.mcap`` file of a bag given as its folder or as the file itself."""
    bag = Path(bag)
    if bag.is_file():
        return bag
    files = sorted(bag.glob("*.mcap")) if bag.is_dir() else []
    if len(files) != 1:
        raise BagError(f"{bag}: expected a bag folder with one .mcap file, got {len(files)}")
    return files[0]


def read_summary(path: Path) -> tuple[Summary, Statistics] | None:
    """Summary of a file, or None if it has none: its recorder was killed, or is still at work."""
    try:
        with open(path, "rb") as file:
            summary = make_reader(BoundedFile(file)).get_summary()  # type: ignore[arg-type]
    except NONSENSE:
        return None
    return None if summary is None or summary.statistics is None else (summary, summary.statistics)


def type_of(summary: Summary, channel: Channel) -> str:
    """Type of a channel's messages; empty if the file does not say."""
    schema = summary.schemas.get(channel.schema_id)
    return schema.name if schema is not None else ""


def repair(bag: Path) -> Repaired:
    """Make a bag whole in place; one that is whole already stays as it is."""
    path = mcap_file(bag)
    if (found := read_summary(path)) is not None:
        _complete_folder(path, _contents_of(*found))
        return Repaired(path, found[1].message_count, was_whole=True)
    try:
        with open(path, "r+b") as file:
            scan = scan_file(file, path)
            size = os.fstat(file.fileno()).st_size
            file.truncate(scan.end)
            kept_end = scan.end
            _add_journal(file, scan, path)
            file.seek(scan.end)
            _finish(file, scan, path.name)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise BagError(f"cannot repair {path}: {error.strerror}") from error
    _complete_folder(path, scan.contents)
    return Repaired(path, sum(scan.counts.values()), max(0, size - kept_end))


def _contents_of(summary: Summary, statistics: Statistics) -> Contents:
    contents = Contents(start_ns=statistics.message_start_time, end_ns=statistics.message_end_time)
    for channel in summary.channels.values():
        rihs = channel.metadata.get("topic_type_hash", "")
        contents.add_topic(channel.topic, type_of(summary, channel), rihs)
        contents.counts[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
    return contents


def _complete_folder(path: Path, contents: Contents) -> None:
    """Write ``metadata.yaml`` where it is missing, and drop what the recorder left beside it."""
    (path.parent / ".reserve").unlink(missing_ok=True)
    journal_of(path).unlink(missing_ok=True)
    if not (path.parent / METADATA_FILE).exists():
        write_atomically(path.parent / METADATA_FILE, rosbag2_metadata(path.name, contents))


def _add_journal(file: BinaryIO, scan: Scan, path: Path) -> None:
    """Append, as one more chunk, the messages of the chunk that the recorder was filling."""
    position, entries = read_journal(path)
    # A chunk behind that position is the one: the recorder died, or an earlier repair, before the journal was emptied.
    if not entries or any(chunk.chunk_start_offset >= position for chunk in scan.chunks):
        return
    builder = RecordBuilder()
    ids = {channel.topic: channel.id for channel in scan.channels.values()}
    for entry in entries:
        if entry.topic not in ids:
            ids[entry.topic] = _introduce(builder, scan, entry.topic, max(ids.values(), default=0) + 1)
        times = {"log_time": entry.log_ns, "publish_time": entry.publish_ns}
        Message(channel_id=ids[entry.topic], data=entry.cdr, sequence=entry.sequence, **times).write(builder)
    data = bytes(builder.end())
    chunk = Chunk(
        compression="", data=data, message_start_time=min(entry.log_ns for entry in entries),
        message_end_time=max(entry.log_ns for entry in entries), uncompressed_crc=zlib.crc32(data), uncompressed_size=len(data),
    )  # fmt: skip
    chunk.write(builder)
    length = builder.count
    file.seek(scan.end)
    file.write(builder.end())
    note_chunk(scan, chunk, length)
    scan.end += length
    redo_last_index(file, scan)


def _introduce(builder: RecordBuilder, scan: Scan, topic: str, channel_id: int) -> int:
    """Write schema and channel of a topic whose first message is in the journal."""
    typename = topic_row(topic).type
    known = {schema.name: schema.id for schema in scan.schemas.values()}
    if typename not in known:
        schema = Schema(
            id=max(scan.schemas, default=0) + 1,
            name=typename,
            encoding="ros2msg",
            data=type_definition(typename).encode(),
        )
        scan.schemas[schema.id] = schema
        schema.write(builder)
        known[typename] = schema.id
    metadata = {"topic_type_hash": type_hash(typename)}
    Channel(id=channel_id, topic=topic, message_encoding="cdr", metadata=metadata, schema_id=known[typename]).write(
        builder
    )
    return channel_id


def _finish(file: BinaryIO, scan: Scan, file_name: str) -> None:
    """Append what ends an MCAP file: bag metadata, end of data, summary, footer."""
    builder = RecordBuilder()
    text = rosbag2_metadata(file_name, scan.contents)
    # Of what was lost on the way, the recorder took its count with it; the gaps in the sequence numbers are still there.
    lost = {f"lost {topic}": str(count) for topic, count in scan.lost.items()}
    for name, metadata in (("advnerf_end", {**lost, "repaired": "yes"}), ("rosbag2", {"serialized_metadata": text})):
        if name not in scan.metadata_names:
            before = builder.count
            Metadata(name=name, metadata=metadata).write(builder)
            scan.metadata.append(MetadataIndex(offset=scan.end + before, length=builder.count - before, name=name))
    DataEnd(0).write(builder)
    summary_start = scan.end + builder.count
    file.write(builder.end())
    summary, offsets_start = _summary(scan, summary_start)
    head = RECORD_HEAD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", summary_start, offsets_start)
    Footer(summary_start, offsets_start, zlib.crc32(head, zlib.crc32(summary))).write(builder)
    file.write(summary + builder.end() + MCAP0_MAGIC)


def _summary(scan: Scan, start: int) -> tuple[bytes, int]:
    """Bytes of the summary section that begins at ``start``, and where its table of offsets begins."""
    statistics = Statistics(
        attachment_count=len(scan.attachments), channel_count=len(scan.channels), channel_message_counts=dict(scan.counts),
        chunk_count=len(scan.chunks), message_count=sum(scan.counts.values()), message_end_time=scan.contents.end_ns,
        message_start_time=scan.contents.start_ns, metadata_count=len(scan.metadata), schema_count=len(scan.schemas),
    )  # fmt: skip
    groups: list[tuple[int, list[Any]]] = [
        (Opcode.SCHEMA, list(scan.schemas.values())),
        (Opcode.CHANNEL, list(scan.channels.values())),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, list(scan.chunks)),
        (Opcode.ATTACHMENT_INDEX, list(scan.attachments)),
        (Opcode.METADATA_INDEX, list(scan.metadata)),
    ]
    builder = RecordBuilder()
    offsets: list[SummaryOffset] = []
    for opcode, records in groups:
        before = builder.count
        _each(records, lambda record: record.write(builder))
        if records:
            offsets.append(
                SummaryOffset(group_opcode=opcode, group_start=start + before, group_length=builder.count - before)
            )
    offsets_start = start + builder.count
    _each(offsets, lambda offset: offset.write(builder))
    return bytes(builder.end()), offsets_start


def _each(records: list[Any], do: Callable[[Any], None]) -> None:
    for record in records:
        do(record)
