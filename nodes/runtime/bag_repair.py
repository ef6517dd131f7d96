"""Make an unfinished bag whole: cut off what was half written, add the summary that a killed recorder never wrote.

It works in place, because a bag may be larger than what is left on the disk, and it can be run again if it is interrupted.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from advnerf_core.files import write_atomically
from nodes.runtime.bag import METADATA_FILE, Contents, rosbag2_metadata
from nodes.runtime.errors import BagError

_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD_BYTES = 9


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


@dataclass
class _Scan:
    """Everything the summary needs, gathered from the data section."""

    end: int = len(MCAP0_MAGIC)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    contents: Contents = field(default_factory=Contents)
    counts: dict[int, int] = field(default_factory=dict)
    last_index: list[MessageIndex] = field(default_factory=list)
    has_rosbag2: bool = False


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
            summary = make_reader(file).get_summary()
    except (McapError, ValueError, struct.error):
        return None
    return None if summary is None or summary.statistics is None else (summary, summary.statistics)


def repair(bag: Path) -> Repaired:
    """Make a bag whole in place; one that is whole already stays as it is."""
    path = mcap_file(bag)
    if (found := read_summary(path)) is not None:
        _complete_folder(path, _contents_of(*found))
        return Repaired(path, found[1].message_count, was_whole=True)
    try:
        with open(path, "r+b") as file:
            scan = _scan(file, path)
            size = os.fstat(file.fileno()).st_size
            file.truncate(scan.end)
            file.seek(scan.end)
            _finish(file, scan, path.name)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise BagError(f"cannot repair {path}: {error.strerror}") from error
    _complete_folder(path, scan.contents)
    return Repaired(path, sum(scan.counts.values()), max(0, size - scan.end))


def _contents_of(summary: Summary, statistics: Statistics) -> Contents:
    contents = Contents(start_ns=statistics.message_start_time, end_ns=statistics.message_end_time)
    for channel in summary.channels.values():
        rihs = channel.metadata.get("topic_type_hash", "")
        contents.add_topic(channel.topic, summary.schemas[channel.schema_id].name, rihs)
        contents.counts[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
    return contents


def _complete_folder(path: Path, contents: Contents) -> None:
    """Write ``metadata.yaml`` where it is missing, and drop the space a recorder held back."""
    (path.parent / ".reserve").unlink(missing_ok=True)
    if not (path.parent / METADATA_FILE).exists():
        write_atomically(path.parent / METADATA_FILE, rosbag2_metadata(path.name, contents))


def _scan(file: BinaryIO, path: Path) -> _Scan:
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise BagError(f"{path}: expected an MCAP file, but it does not begin like one")
    scan = _Scan()
    while (record := _next_record(file)) is not None:
        opcode, body = record
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            break
        if not _note(scan, opcode, body):
            break
        scan.end += _RECORD_HEAD.size + len(body)
    if scan.chunks:
        _redo_last_index(file, scan)
    return scan


def _next_record(file: BinaryIO) -> tuple[int, bytes] | None:
    """Opcode and body of the next whole record; None at the end or where it was cut off."""
    head = file.read(_RECORD_HEAD.size)
    if len(head) < _RECORD_HEAD.size:
        return None
    opcode, length = _RECORD_HEAD.unpack(head)
    remaining = os.fstat(file.fileno()).st_size - file.tell()
    if opcode == 0 or length > remaining:
        return None
    return opcode, file.read(length)


def _note(scan: _Scan, opcode: int, body: bytes) -> bool:
    """Take a record into the scan; False where the file stops making sense."""
    stream = ReadDataStream(io.BytesIO(body))
    length = _RECORD_HEAD.size + len(body)
    try:
        if opcode == Opcode.CHUNK:
            _note_chunk(scan, Chunk.read(stream), length)
        elif opcode == Opcode.MESSAGE_INDEX and scan.chunks:
            scan.chunks[-1].message_index_offsets[MessageIndex.read(stream).channel_id] = scan.end
            scan.chunks[-1].message_index_length += length
        elif opcode == Opcode.ATTACHMENT:
            a = Attachment.read(stream)
            index = AttachmentIndex(scan.end, length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
            scan.attachments.append(index)
        elif opcode == Opcode.METADATA:
            name = Metadata.read(stream).name
            scan.has_rosbag2 |= name == "rosbag2"
            scan.metadata.append(MetadataIndex(offset=scan.end, length=length, name=name))
        elif opcode == Opcode.HEADER:
            Header.read(stream)
        else:
            return False
    except (McapError, ValueError, struct.error, KeyError):
        return False
    return True


def _note_chunk(scan: _Scan, chunk: Chunk, length: int) -> None:
    if chunk.uncompressed_crc and not chunk.compression and zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise ValueError("chunk is damaged")
    indexes: dict[int, MessageIndex] = {}
    position = 0
    for record in breakup_chunk(chunk, validate_crc=True):
        if isinstance(record, Schema):
            scan.schemas[record.id] = record
        elif isinstance(record, Channel):
            scan.channels[record.id] = record
            typename = scan.schemas[record.schema_id].name
            scan.contents.add_topic(record.topic, typename, record.metadata.get("topic_type_hash", ""))
        elif isinstance(record, Message):
            index = indexes.setdefault(record.channel_id, MessageIndex(record.channel_id, []))
            index.records.append((record.log_time, position))
            scan.contents.add_message(scan.channels[record.channel_id].topic, record.log_time)
            scan.counts[record.channel_id] = scan.counts.get(record.channel_id, 0) + 1
        position += _length_of(record)
    scan.last_index = list(indexes.values())
    scan.chunks.append(
        ChunkIndex(
            chunk_length=length, chunk_start_offset=scan.end, compression=chunk.compression,
            compressed_size=len(chunk.data), message_end_time=chunk.message_end_time, message_index_length=0,
            message_index_offsets={}, message_start_time=chunk.message_start_time, uncompressed_size=chunk.uncompressed_size,
        )
    )  # fmt: skip


def _length_of(record: Any) -> int:
    """Bytes of a record inside a chunk."""
    if isinstance(record, Message):
        return _MESSAGE_HEAD_BYTES + 22 + len(record.data)
    builder = RecordBuilder()
    record.write(builder)
    return int(builder.count)


def _redo_last_index(file: BinaryIO, scan: _Scan) -> None:
    """Write the message index of the last chunk again: it may have been cut off in the middle."""
    chunk = scan.chunks[-1]
    chunk_end = chunk.chunk_start_offset + chunk.chunk_length
    if scan.end != chunk_end + chunk.message_index_length or len(chunk.message_index_offsets) == len(scan.last_index):
        return
    file.truncate(chunk_end)
    file.seek(chunk_end)
    builder = RecordBuilder()
    chunk.message_index_offsets.clear()
    for index in scan.last_index:
        chunk.message_index_offsets[index.channel_id] = chunk_end + builder.count
        index.write(builder)
    chunk.message_index_length = builder.count
    file.write(builder.end())
    scan.end = chunk_end + chunk.message_index_length


def _finish(file: BinaryIO, scan: _Scan, file_name: str) -> None:
    """Append what ends an MCAP file: bag metadata, end of data, summary, footer."""
    builder = RecordBuilder()
    if not scan.has_rosbag2:
        text = rosbag2_metadata(file_name, scan.contents)
        Metadata(name="rosbag2", metadata={"serialized_metadata": text}).write(builder)
        scan.metadata.append(MetadataIndex(offset=scan.end, length=builder.count, name="rosbag2"))
    DataEnd(0).write(builder)
    summary_start = scan.end + builder.count
    file.write(builder.end())
    summary, offsets_start = _summary(scan, summary_start)
    head = _RECORD_HEAD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", summary_start, offsets_start)
    Footer(summary_start, offsets_start, zlib.crc32(head, zlib.crc32(summary))).write(builder)
    file.write(summary + builder.end() + MCAP0_MAGIC)


def _summary(scan: _Scan, start: int) -> tuple[bytes, int]:
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
