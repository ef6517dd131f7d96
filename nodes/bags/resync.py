"""Where an MCAP file makes sense again behind damage: the next place at which records follow each other."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from nodes.bags.records import (
    DATA_END_BYTES,
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
# So many records in a row are no accident; one is enough where a checksum agrees.
_IN_A_ROW = 3
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata,
}  # fmt: skip


def only_zeros(buffer: Any, at: int) -> bool:
    """Whether nothing but zeros follows: a file system after a power cut."""
    return _NOT_ZERO.search(buffer, at) is None


def next_record(buffer: Any, at: int, limit: int, channels: Collection[int], messages: bool) -> int | None:
    """The next place behind ``at`` from which records follow each other; None if there is none.

    Args:
        buffer: The file.
        at: Where it is damaged.
        limit: Where the data end.
        channels: Ids that messages may have; empty for any.
        messages: Whether messages outside chunks count; in a file with chunks they would be found inside a damaged chunk.
    """
    for candidate in _CANDIDATE.finditer(buffer, at + 1, limit):
        if makes_sense(buffer, candidate.start(), limit, channels, messages):
            return candidate.start()
    return None


def plausible_end(buffer: Any, at: int, limit: int) -> bool:
    """Whether a record may begin here, or the data end: enough where another length has already agreed."""
    if at == limit:
        return True
    try:
        opcode, body, end = record_at(buffer, at, limit)
    except Damaged:
        # Cut off: then what was said about this place before is all there is.
        return at + RECORD_HEAD.size > limit or 0 < buffer[at] <= Opcode.DATA_END
    return 0 < opcode <= Opcode.DATA_END and (opcode != Opcode.DATA_END or end - body == 4)


def makes_sense(buffer: Any, at: int, limit: int, channels: Collection[int], messages: bool) -> bool:
    """Whether records follow each other from here on, or the data end."""
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
    """End of a record that makes sense, and whether a checksum says so too."""
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
        # What follows is the summary, whose records have opcodes of their own.
        if not sure and buffer[end] not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.FOOTER):
            raise Damaged("not an end of data")
        sure = True
    elif opcode in _KINDS:
        parse(_KINDS[opcode], bytes(buffer[body:end]))
    else:
        raise Damaged("not a record of the data section")
    return end, sure
