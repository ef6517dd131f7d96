"""Assembles an intact MCAP file from the pieces that a scan of a damaged file keeps."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    SummaryOffset,
)

from nodes.bags.metadata import Contents, rosbag2_metadata
from nodes.bags.part import LIBRARY, PROFILE
from nodes.bags.records import MAGIC, RECORD_HEAD, bytes_of
from nodes.bags.scanned import Piece, Scan

ENDS, REPAIRS = "advnerf_end", "advnerf_repair"


@dataclass
class FileLayout:
    """The parts of the new file in order: ranges of the old file, or bytes."""

    parts: list[range | bytes]

    @property
    def unchanged(self) -> int:
        """Number of bytes at the beginning that are the same as in the old file."""
        at = 0
        for part in self.parts:
            if not isinstance(part, range) or part.start != at:
                break
            at = part.stop
        return at


def recorded_here(scan: Scan) -> bool:
    """Whether the advnerf recorder wrote the file. If so, a gap in the sequence numbers is a loss."""
    return scan.header is not None and scan.header.library.startswith(LIBRARY)


def contents_of(scan: Scan) -> Contents:
    """Contents of ``metadata.yaml``."""
    return Contents.of(scan.channels, scan.schemas, scan.counts, (scan.start_ns, scan.end_ns))


def assemble(scan: Scan, file_name: str, notes: dict[str, str]) -> FileLayout:
    """Place every piece and write the end of the file.

    Args:
        scan: The scan. The entries of its pieces get their new offsets.
        notes: Notes about the repair to store in the file.
    """
    pieces = _with_what_is_missing(scan)
    parts: list[range | bytes] = [range(len(MAGIC))] if "first eight" not in " ".join(scan.fixes) else [MAGIC]
    at = len(MAGIC)
    for piece in pieces:
        part = range(piece.offset, piece.offset + piece.length) if piece.content is None else piece.content
        _move(piece.record, at - piece.offset)
        _append(parts, part)
        at += len(part)
    entries = [piece.record for piece in pieces if piece.record is not None]
    changed = scan.losses or scan.fixes or scan.lost_definitions or scan.data_crc_wrong
    if scan.data_end is not None and not changed:
        _append(parts, range(scan.data_end, scan.data_end + RECORD_HEAD.size + 4))
        at += RECORD_HEAD.size + 4
    else:
        tail = _metadata(scan, file_name, notes, at, entries)
        parts.append(tail)
        at += len(tail)
    parts.append(_ending(scan, entries, at))
    return FileLayout(parts)


def _with_what_is_missing(scan: Scan) -> list[Piece]:
    pieces = list(scan.pieces)
    if scan.lost_definitions and scan.insert_at is not None:
        pieces.insert(scan.insert_at, Piece(0, 0, content=b"".join(map(bytes_of, scan.lost_definitions))))
    if scan.header is None:
        profile = (
            PROFILE if any(channel.message_encoding == "cdr" for channel in scan.channels.values()) else ""
        )
        pieces.insert(0, Piece(0, 0, content=bytes_of(Header(profile, LIBRARY + " repair"))))
    return pieces


def _append(parts: list[range | bytes], part: range | bytes) -> None:
    last = parts[-1]
    if isinstance(part, range) and isinstance(last, range) and last.stop == part.start:
        parts[-1] = range(last.start, part.stop)
    elif len(part):
        parts.append(part)


def _move(record: Any, by: int) -> None:
    if isinstance(record, ChunkIndex):
        record.chunk_start_offset += by
        for channel_id in record.message_index_offsets:
            record.message_index_offsets[channel_id] += by
    elif record is not None:
        record.offset += by


def _metadata(scan: Scan, file_name: str, notes: dict[str, str], at: int, entries: list[Any]) -> bytes:
    """Metadata that the killed recorder did not write, and the end of the data."""
    present = {entry.name for entry in entries if isinstance(entry, MetadataIndex)}
    records = []
    if recorded_here(scan) and ENDS not in present:
        # The recorder's count of lost messages is gone, but the gaps in the sequence numbers are still in the file.
        lost: dict[str, int] = {}
        for channel_id, gap in scan.gaps.items():
            topic = scan.channels[channel_id].topic
            lost[topic] = lost.get(topic, 0) + gap
        topics = {channel.topic for channel in scan.channels.values()}
        records.append(Metadata(ENDS, {f"lost {topic}": str(lost.get(topic, 0)) for topic in sorted(topics)}))
    if "rosbag2" not in present:
        records.append(
            Metadata("rosbag2", {"serialized_metadata": rosbag2_metadata({file_name: contents_of(scan)})})
        )
    records.append(Metadata(REPAIRS, notes))
    content = b""
    for record in records:
        row = bytes_of(record)
        entries.append(MetadataIndex(offset=at + len(content), length=len(row), name=record.name))
        content += row
    return content + bytes_of(DataEnd(0))


def _ending(scan: Scan, entries: Sequence[Any], start: int) -> bytes:
    """Bytes of the summary section that begins at ``start``, the footer and the magic."""
    summary, offsets_start = _summary(scan, entries, start)
    head = (
        RECORD_HEAD.pack(Opcode.FOOTER, 20)
        + start.to_bytes(8, "little")
        + offsets_start.to_bytes(8, "little")
    )
    return summary + bytes_of(Footer(start, offsets_start, zlib.crc32(head, zlib.crc32(summary)))) + MAGIC


def _summary(scan: Scan, entries: Sequence[Any], start: int) -> tuple[bytes, int]:
    """Bytes of the summary section that begins at ``start``, and the offset of its table of offsets."""
    kinds = {kind: [entry for entry in entries if isinstance(entry, kind)] for kind in _KINDS}
    counts = [len(kinds[kind]) for kind in (AttachmentIndex, ChunkIndex, MetadataIndex)]
    statistics = scan.statistics(*counts)
    groups: list[tuple[int, list[Any]]] = [
        (Opcode.SCHEMA, list(scan.schemas.values())),
        (Opcode.CHANNEL, list(scan.channels.values())),
        (Opcode.STATISTICS, [statistics]),
        *((opcode, kinds[kind]) for kind, opcode in _KINDS.items()),
    ]
    builder, offsets = RecordBuilder(), []
    for opcode, records in groups:
        before = builder.count
        for record in records:
            record.write(builder)
        if records:
            offsets.append(SummaryOffset(opcode, start + before, builder.count - before))
    offsets_start = start + builder.count
    for offset in offsets:
        offset.write(builder)
    return bytes(builder.end()), offsets_start


_KINDS: dict[Any, int] = {
    ChunkIndex: Opcode.CHUNK_INDEX, AttachmentIndex: Opcode.ATTACHMENT_INDEX, MetadataIndex: Opcode.METADATA_INDEX,
}  # fmt: skip
