"""Finds the next valid records of an MCAP file after damage, and says whether the file ends in one."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from nodes.bags.records import (
    CHUNK_HEAD_BYTES,
    DATA_END_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Damaged,
    checked_attachment,
    chunk_head,
    index_entries,
    parse,
    record_at,
    records_of,
    unpack_chunk,
)
from nodes.runtime.errors import BagError

# An opcode of the data section and a length below 4 GiB.
_CANDIDATE = re.compile(rb"(?=[\x03-\x07\x09\x0c\x0f][\x00-\xff]{4}\x00{4})", re.DOTALL)
_NOT_ZERO = re.compile(rb"[^\x00]")
# This many valid records in a row are not a coincidence. One is enough if its checksum is right.
_IN_A_ROW = 3
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata,
}  # fmt: skip


def only_zeros(buffer: Any, at: int) -> bool:
    """Whether only zeros follow, as after a power cut."""
    return _NOT_ZERO.search(buffer, at) is None


def next_file(buffer: Any, at: int) -> int | None:
    """Return the next offset from ``at`` on at which another MCAP file begins; None without one."""
    while (at := buffer.find(MAGIC, at)) >= 0:
        with contextlib.suppress(Damaged):
            if record_at(buffer, at + len(MAGIC), len(buffer))[0] == Opcode.HEADER:
                return at
        at += 1
    return None


def next_record(buffer: Any, at: int, limit: int, channels: Collection[int], messages: bool) -> int | None:
    """Return the next offset after ``at`` from which valid records follow; None without one.

    Args:
        at: Offset of the damage.
        limit: End of the data.
        channels: Valid channel ids of messages; empty for any.
        messages: Whether messages outside chunks are accepted. In a file with chunks, they would be found inside a damaged chunk.
    """
    for candidate in _CANDIDATE.finditer(buffer, at + 1, limit):
        if makes_sense(buffer, candidate.start(), limit, channels, messages):
            return candidate.start()
    return None


def plausible_end(buffer: Any, at: int, limit: int) -> bool:
    """Whether a record may begin here or the data end here. This suffices if another length already agrees."""
    if at == limit:
        return True
    try:
        opcode, body, end = record_at(buffer, at, limit)
    except Damaged:
        # The file ends here, so only the earlier evidence is available.
        return at + RECORD_HEAD.size > limit or 0 < buffer[at] <= Opcode.DATA_END
    return 0 < opcode <= Opcode.DATA_END and (opcode != Opcode.DATA_END or end - body == 4)


def makes_sense(buffer: Any, at: int, limit: int, channels: Collection[int], messages: bool) -> bool:
    """Whether valid records follow from here, or the data end."""
    for count in range(_IN_A_ROW):
        if at == limit:
            return count > 0
        try:
            end, sure = _judge(buffer, at, limit, channels, messages)
        except (Damaged, BagError):
            return False
        if sure:
            return True
        at = end
    return True


def _judge(buffer: Any, at: int, limit: int, channels: Collection[int], messages: bool) -> tuple[int, bool]:
    """End of a valid record, and whether its checksum is verified."""
    opcode, body, end = record_at(buffer, at, limit)
    sure = False
    if opcode == Opcode.MESSAGE:
        if not messages or end - body < MESSAGE_HEAD.size:
            raise Damaged("not a message")
        if channels and MESSAGE_HEAD.unpack_from(buffer, body)[0] not in channels:
            raise Damaged("not a message of a known channel")
    elif opcode == Opcode.CHUNK:
        head = chunk_head(buffer, body, end - body)
        for _ in records_of(unpack_chunk(head, bytes(buffer[head.data_at : end]))):
            pass
        sure = head.crc != 0
    elif opcode == Opcode.MESSAGE_INDEX:
        index_entries(bytes(buffer[body:end]))
    elif opcode == Opcode.ATTACHMENT:
        sure = checked_attachment(bytes(buffer[body:end]))[1]
    elif opcode == Opcode.DATA_END:
        if end - at != DATA_END_BYTES:
            raise Damaged("not an end of data")
        sure = end == limit
        # The summary follows, whose records have other opcodes.
        if not sure and buffer[end] not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.FOOTER):
            raise Damaged("not an end of data")
        sure = True
    elif opcode in _KINDS:
        parse(_KINDS[opcode], bytes(buffer[body:end]))
    else:
        raise Damaged("not a record of the data section")
    return end, sure


def runs_over(buffer: Any, at: int, limit: int) -> bool:
    """Whether the record that begins here would end after the end of the file."""
    if at + RECORD_HEAD.size > limit:
        return True
    opcode, length = RECORD_HEAD.unpack_from(buffer, at)
    return 0 < opcode <= Opcode.DATA_END and length > limit - at - RECORD_HEAD.size


def is_cut(buffer: Any, at: int, limit: int) -> bool:
    """Whether the file certainly ends in this record: in its head, or in data whose two lengths agree."""
    if not runs_over(buffer, at, limit):
        return False
    if at + RECORD_HEAD.size > limit:
        return True
    opcode, length = RECORD_HEAD.unpack_from(buffer, at)
    if opcode == Opcode.CHUNK:
        if limit - at < RECORD_HEAD.size + CHUNK_HEAD_BYTES:
            return True
        try:
            chunk_head(buffer, at + RECORD_HEAD.size, length)
        except Damaged:
            return False
        return True
    return opcode == Opcode.ATTACHMENT and _attachment_agrees(buffer, at + RECORD_HEAD.size, length)


def _attachment_agrees(buffer: Any, body: int, length: int) -> bool:
    """Whether the length inside an attachment agrees with its record's. The end of the attachment may be missing."""
    at = body + 16
    for _ in range(2):
        if at + 4 > len(buffer):
            return True
        at += 4 + int.from_bytes(buffer[at : at + 4], "little")
    if at + 8 > len(buffer):
        return at < body + length
    return at + 8 + int.from_bytes(buffer[at : at + 8], "little") + 4 == body + length
