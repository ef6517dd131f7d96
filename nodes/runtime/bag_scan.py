"""Everything an MCAP file holds, gathered from its data section: what its summary would say, had it been written."""

from __future__ import annotations

import io
import os
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from nodes.runtime.bag_file import NONSENSE
from nodes.runtime.bag_metadata import Contents
from nodes.runtime.errors import BagError

RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD_BYTES = 9


@dataclass
class Scan:
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
    sequences: dict[int, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)

    @property
    def metadata_names(self) -> set[str]:
        """Names of the metadata records."""
        return {index.name for index in self.metadata}


def scan_file(file: BinaryIO, path: Path) -> Scan:
    """Read a file from its beginning to where it ends or stops making sense; `Scan.end` is that place."""
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise BagError(f"{path}: expected an MCAP file, but it does not begin like one")
    scan = Scan()
    while (record := _next_record(file)) is not None:
        opcode, body = record
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            break
        if not _note(scan, opcode, body):
            break
        scan.end += RECORD_HEAD.size + len(body)
    if scan.chunks:
        redo_last_index(file, scan)
    return scan


def _next_record(file: BinaryIO) -> tuple[int, bytes] | None:
    """Opcode and body of the next whole record; None at the end or where it was cut off."""
    head = file.read(RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        return None
    opcode, length = RECORD_HEAD.unpack(head)
    remaining = os.fstat(file.fileno()).st_size - file.tell()
    if opcode == 0 or length > remaining:
        return None
    return opcode, file.read(length)


def _note(scan: Scan, opcode: int, body: bytes) -> bool:
    """Take a record into the scan; False where the file stops making sense."""
    stream = ReadDataStream(io.BytesIO(body))
    length = RECORD_HEAD.size + len(body)
    try:
        if opcode == Opcode.CHUNK:
            note_chunk(scan, Chunk.read(stream), length)
        elif opcode == Opcode.MESSAGE_INDEX and scan.chunks:
            scan.chunks[-1].message_index_offsets[MessageIndex.read(stream).channel_id] = scan.end
            scan.chunks[-1].message_index_length += length
        elif opcode == Opcode.ATTACHMENT:
            a = Attachment.read(stream)
            index = AttachmentIndex(scan.end, length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
            scan.attachments.append(index)
        elif opcode == Opcode.METADATA:
            name = Metadata.read(stream).name
            scan.metadata.append(MetadataIndex(offset=scan.end, length=length, name=name))
        elif opcode == Opcode.HEADER:
            Header.read(stream)
        else:
            return False
    except NONSENSE:
        return False
    return True


def note_chunk(scan: Scan, chunk: Chunk, length: int) -> None:
    """Take a chunk that begins at `Scan.end` and is so many bytes long, with its head, into the scan."""
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
            _note_gap(scan, record)
        position += _length_of(record)
    scan.last_index = list(indexes.values())
    scan.chunks.append(
        ChunkIndex(
            chunk_length=length, chunk_start_offset=scan.end, compression=chunk.compression,
            compressed_size=len(chunk.data), message_end_time=chunk.message_end_time, message_index_length=0,
            message_index_offsets={}, message_start_time=chunk.message_start_time, uncompressed_size=chunk.uncompressed_size,
        )
    )  # fmt: skip


def _note_gap(scan: Scan, message: Message) -> None:
    """Count what is missing between two messages; a step back is a publisher that was started again."""
    topic, last = scan.channels[message.channel_id].topic, scan.sequences.get(message.channel_id)
    gap = 0 if last is None or message.sequence <= last else message.sequence - last - 1
    scan.lost[topic] = scan.lost.get(topic, 0) + gap
    scan.sequences[message.channel_id] = message.sequence


def _length_of(record: Any) -> int:
    """Bytes of a record inside a chunk."""
    if isinstance(record, Message):
        return _MESSAGE_HEAD_BYTES + 22 + len(record.data)
    builder = RecordBuilder()
    record.write(builder)
    return int(builder.count)


def redo_last_index(file: BinaryIO, scan: Scan) -> None:
    """Write the message index of the last chunk again where it is missing or was cut off in the middle."""
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
