"""Reads the end of an MCAP file: the footer and the summary before it, with checksums."""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Footer, MetadataIndex, Schema, Statistics
from mcap.summary import Summary

from nodes.bags.records import FOOTER_BYTES, MAGIC, Damaged, parse, record_at

_CRC_BYTES = 4


class Ending(NamedTuple):
    """Contents of the footer.

    Attributes:
        summary_start: Offset of the summary; 0 without one.
        summary_crc: Checksum of summary and footer; 0 means none.
        footer_at: Offset of the footer.
    """

    summary_start: int
    summary_crc: int
    footer_at: int


def read_ending(buffer: Any, size: int) -> Ending | None:
    """Read the footer of a file; None if the file does not end with one."""
    at = size - FOOTER_BYTES - len(MAGIC)
    if at < len(MAGIC) or buffer[size - len(MAGIC) : size] != MAGIC:
        return None
    content = bytes(buffer[at : at + FOOTER_BYTES])
    try:
        opcode, body, end = record_at(content, 0, len(content))
        footer = parse(Footer, content[body:end])
    except Damaged:
        return None
    if opcode != Opcode.FOOTER or not (footer.summary_start == 0 or len(MAGIC) < footer.summary_start <= at):
        return None
    return Ending(footer.summary_start, footer.summary_crc, at)


def read_summary_section(buffer: Any, ending: Ending) -> Summary:
    """Read the records of the summary.

    Raises:
        Damaged: The checksum is wrong, or the summary is invalid.
    """
    end = ending.footer_at + FOOTER_BYTES - _CRC_BYTES
    content = bytes(buffer[ending.summary_start : end])
    if ending.summary_crc and (found := zlib.crc32(content)) != ending.summary_crc:
        raise Damaged(
            f"the checksum of its summary is {ending.summary_crc:08x}, that of its content {found:08x}"
        )
    summary, at, limit = Summary(), 0, ending.footer_at - ending.summary_start
    while at < limit:
        opcode, body, at = record_at(content, at, limit)
        _add(summary, opcode, content[body:at])
    return summary


def _add(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == Opcode.STATISTICS:
        summary.statistics = parse(Statistics, body)
    elif opcode == Opcode.SCHEMA:
        schema = parse(Schema, body)
        summary.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = parse(Channel, body)
        summary.channels[channel.id] = channel
    elif opcode == Opcode.CHUNK_INDEX:
        summary.chunk_indexes.append(parse(ChunkIndex, body))
    elif opcode == Opcode.ATTACHMENT_INDEX:
        summary.attachment_indexes.append(parse(AttachmentIndex, body))
    elif opcode == Opcode.METADATA_INDEX:
        summary.metadata_indexes.append(parse(MetadataIndex, body))
