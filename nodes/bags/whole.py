"""Reads and checks the summary of a finished file. If the summary is incomplete, the data are scanned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Statistics
from mcap.summary import Summary

from nodes.bags.file import mapped
from nodes.bags.records import DATA_END_BYTES, MAGIC, RECORD_HEAD, Damaged, record_at
from nodes.bags.scan import scan_file
from nodes.bags.scanned import MessageRun, Scan
from nodes.bags.summary import Ending, read_ending, read_summary_section
from nodes.runtime.errors import BagError

_CRC_AT = RECORD_HEAD.size + 24  # of a chunk


class FileSummary(Summary):
    """The summary of a file.

    Attributes:
        statistics: Counts and times, which every file has here.
        runs: Messages outside chunks.
        unchecked: Why damage to messages may go unnoticed; empty if checksums cover them.
    """

    statistics: Statistics
    runs: list[MessageRun]
    unchecked: str


def read_summary(path: Path) -> FileSummary | None:
    """Read the summary of a file; None if the file is unfinished because its recorder was killed or is still running.

    Raises:
        BagError: The file is finished, but damaged.
    """
    with mapped(path) as buffer:
        ending = read_ending(buffer, len(buffer))
        if ending is None:
            return None
        try:
            found = _from_summary(buffer, ending)
        except Damaged as error:
            raise BagError(
                f"{path} is damaged: {error}; advnerf bag repair {path} rewrites the summary if the messages are intact"
            ) from error
    return _from_data(path) if found is None else found


def _from_summary(buffer: Any, ending: Ending) -> FileSummary | None:
    """Read the summary of the file; None if it is incomplete or has no checksum."""
    # Without a checksum, its list of topics or times may be damaged, and messages would be missed.
    if not ending.summary_start or not ending.summary_crc:
        return None
    read = read_summary_section(buffer, ending)
    if read.statistics is None or not _lists_everything(buffer, ending, read):
        return None
    summary = FileSummary()
    summary.__dict__.update(read.__dict__)
    summary.runs, summary.unchecked = [], ""
    for index in read.chunk_indexes:
        at = index.chunk_start_offset + _CRC_AT
        if buffer[at : at + 4] == b"\0\0\0\0" and index.uncompressed_size:
            return None  # only the checksum of all data may cover this chunk
    return summary


def _lists_everything(buffer: Any, ending: Ending, summary: Summary) -> bool:
    """Whether the summary lists all chunks, attachments and metadata of the data, and their channels."""
    statistics = summary.statistics
    assert statistics is not None
    if len(summary.channels) != statistics.channel_count or len(summary.schemas) != statistics.schema_count:
        return False
    spans = [(i.chunk_start_offset, i.chunk_length + i.message_index_length) for i in summary.chunk_indexes]
    spans += [(i.offset, i.length) for i in summary.attachment_indexes]
    spans += [(i.offset, i.length) for i in summary.metadata_indexes]
    try:
        at = record_at(buffer, len(MAGIC), ending.summary_start)[2]
    except Damaged:
        return False
    for offset, length in sorted(spans):
        if offset != at:
            return False
        at += length
    return at == ending.summary_start - DATA_END_BYTES and buffer[at] == Opcode.DATA_END


def _from_data(path: Path) -> FileSummary:
    scan = scan_file(path)
    advice = (
        f"advnerf bag info {path} lists what is damaged, advnerf bag repair {path} keeps what can be kept"
    )
    if scan.summary_damage:
        raise BagError(f"{path} is damaged: {scan.summary_damage}; {advice}")
    if scan.losses:
        raise BagError(f"{path} is damaged: {scan.describe(scan.losses[0])}; {advice}")
    if scan.data_crc_wrong and scan.unchecked:
        raise BagError(f"{path} is damaged: the checksum of its data is wrong; {advice}")
    if not scan.complete:
        raise BagError(f"{path} is damaged: the record that ends its data is missing; {advice}")
    return summary_of(scan)


def summary_of(scan: Scan) -> FileSummary:
    """Make a summary of the contents found in a file."""
    summary = FileSummary()
    summary.schemas, summary.channels = dict(scan.schemas), dict(scan.channels)
    summary.runs, summary.unchecked = scan.runs, scan.unchecked
    for piece in scan.pieces:
        if isinstance(piece.record, ChunkIndex):
            summary.chunk_indexes.append(piece.record)
        elif isinstance(piece.record, AttachmentIndex):
            summary.attachment_indexes.append(piece.record)
        elif piece.record is not None:
            summary.metadata_indexes.append(piece.record)
    summary.statistics = scan.statistics(
        len(summary.attachment_indexes), len(summary.chunk_indexes), len(summary.metadata_indexes)
    )
    return summary
