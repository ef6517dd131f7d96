"""Finds the good records of a chunk whose checksum is wrong: those before the damage, or all but the one that is damaged."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from nodes.bags.file import NONSENSE
from nodes.bags.records import MESSAGE_HEAD, MOST_BYTES, RECORD_HEAD, ChunkHead, Damaged, parse, records_of

_STEP_BYTES = 1024
_TABLE = [zlib.crc32(bytes([byte])) ^ zlib.crc32(b"\0") for byte in range(256)]
_BYTE_OF = {value: byte for byte, value in enumerate(_TABLE)}
_BY_TOP = {value >> 24: (byte, value) for byte, value in enumerate(_TABLE)}


def good_records(
    head: ChunkHead, data: bytes, indexed: Mapping[int, tuple[int, int]], channels: Collection[int]
) -> tuple[bytes, bool]:
    """Find the good records of a damaged chunk, empty without any, and whether the chunk's checksum proves that they are right.

    Otherwise the damage is somewhere after them, as far as their order, channels and times tell.

    Args:
        data: Data of the chunk, compressed or not.
        indexed: Channel and log time [ns] of its messages by offset, from its message indexes; empty without them.
        channels: Ids of the channels that the file had before it.
    """
    records, whole = (data, True) if not head.compression else _unpack_until_damage(head.compression, data)
    if whole and head.crc and (found := _wrong_byte(records, head.crc)) is not None:
        return _without_record_at(records, *found), True
    ends, failed = _plausible_ends(records, head, indexed, channels)
    if not whole:  # what follows could not be unpacked
        return records[: ends[-1]] if ends else b"", False
    if head.compression or not failed:
        # A wrong compressed byte is copied to many places, and a wrong byte of a message does not show.
        return b"", False
    # The damage may have begun in the content of the record before.
    return records[: ends[-2]] if len(ends) > 1 else b"", False


def _unpack_until_damage(compression: str, data: bytes) -> tuple[bytes, bool]:
    """Unpacked content of a chunk up to its damage, and whether all of it could be unpacked."""
    import lz4.frame
    import zstandard

    unpacker = (
        lz4.frame.LZ4FrameDecompressor()
        if compression == "lz4"
        else zstandard.ZstdDecompressor().decompressobj()
    )
    found = bytearray()
    try:
        for at in range(0, len(data), _STEP_BYTES):
            found += unpacker.decompress(data[at : at + _STEP_BYTES])
            if len(found) > MOST_BYTES:
                return b"", False
    except NONSENSE:
        return bytes(found), False
    return bytes(found), bool(unpacker.eof)


def _wrong_byte(records: bytes, crc: int) -> tuple[int, int] | None:
    """Offset of the only wrong byte and its difference to the right one; None if several bytes are wrong.

    CRC-32 is linear: the difference of two checksums depends only on the difference of the data. It is traced back byte by byte, until
    a difference of one byte explains it.
    """
    difference = zlib.crc32(records) ^ crc
    found: tuple[int, int] | None = None
    for at in range(len(records) - 1, -1, -1):
        if (byte := _BYTE_OF.get(difference)) is not None and byte:
            if found is not None:
                return None
            found = at, byte
        low, value = _BY_TOP[difference >> 24]
        difference = ((difference ^ value) << 8 | low) & 0xFFFFFFFF
    return found


def _without_record_at(records: bytes, at: int, difference: int) -> bytes:
    right = bytearray(records)
    right[at] ^= difference
    for _, body, end in records_of(bytes(right)):
        if body - RECORD_HEAD.size <= at < end:
            return bytes(right[: body - RECORD_HEAD.size] + right[end:])
    return bytes(right)


def _plausible_ends(
    records: bytes, head: ChunkHead, indexed: Mapping[int, tuple[int, int]], channels: Collection[int]
) -> tuple[list[int], bool]:
    """Ends of the records up to the first impossible one, and whether there is one."""
    ends: list[int] = []
    known = set(channels)
    try:
        for opcode, body, end in records_of(records):
            if opcode == Opcode.MESSAGE:
                channel_id, _, log_ns, _ = MESSAGE_HEAD.unpack_from(records, body)
                listed = indexed.get(body - RECORD_HEAD.size)
                possible = channel_id in known and head.start_ns <= log_ns <= head.end_ns
                if not (listed == (channel_id, log_ns) if indexed else possible):
                    return ends, True
            elif opcode == Opcode.CHANNEL:
                known.add(parse(Channel, records[body:end]).id)
            elif opcode == Opcode.SCHEMA:
                parse(Schema, records[body:end])
            else:
                return ends, True
            ends.append(end)
    except Damaged:
        return ends, True
    return ends, False
