"""Parses the records of an MCAP file: lengths, contents and checksums."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment

from nodes.bags.file import NONSENSE
from nodes.runtime.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
# Opcode and length, the offsets of summary and summary offsets, and the checksum; followed by the magic.
FOOTER_BYTES = RECORD_HEAD.size + 20
DATA_END_BYTES = RECORD_HEAD.size + 4
# Head of a chunk: start and end time, uncompressed size, CRC; followed by the name of the compression and the length of the data.
_CHUNK_HEAD = struct.Struct("<QQQI")
CHUNK_HEAD_BYTES = _CHUNK_HEAD.size + 4 + 8
# Upper limit of a memory request that a damaged or malicious file can cause.
MOST_BYTES = 1 << 28
_LONGEST_NAME = 64


class Damaged(ValueError):
    """Bytes are inconsistent. The message says how and is used after "it is damaged: "."""


class ChunkHead(NamedTuple):
    """Head of a chunk, before its records. No checksum covers it.

    Attributes:
        start_ns: Log time of its first message [ns since 1970].
        end_ns: Log time of its last message [ns since 1970].
        size: Size of its unpacked records [bytes].
        crc: Checksum of its unpacked records; 0 means none.
        compression: Name of the compression; empty for none.
        data_at: Offset of its data in the parsed bytes.
        data_length: Size of its data [bytes].
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int
    data_length: int


def record_at(buffer: Any, at: int, limit: int) -> tuple[int, int, int]:
    """Return opcode, start and end of the body of the record at an offset. The record must end before ``limit``."""
    if at + RECORD_HEAD.size > limit:
        raise Damaged("a record ends in its first nine bytes")
    opcode, length = RECORD_HEAD.unpack_from(buffer, at)
    body = at + RECORD_HEAD.size
    if opcode == 0:
        raise Damaged("there is no record")
    if length > limit - body:
        raise Damaged(f"a record claims {length} bytes, but {limit - body} are left")
    return opcode, body, body + length


def bytes_of(record: Any) -> bytes:
    """Bytes of a record with its head."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def chunk_head(buffer: Any, body: int, length: int | None) -> ChunkHead:
    """Parse the head of a chunk record. The length of its data must agree with the record's length.

    Args:
        buffer: Bytes that include at least the head.
        body: Offset of the record's body.
        length: Length of the body according to the record; None if it is not reliable.
    """
    try:
        start_ns, end_ns, size, crc = _CHUNK_HEAD.unpack_from(buffer, body)
        at = body + _CHUNK_HEAD.size
        (name_length,) = struct.unpack_from("<I", buffer, at)
        if name_length > _LONGEST_NAME:
            raise Damaged(f"the name of its compression claims {name_length} bytes")
        compression = bytes(buffer[at + 4 : at + 4 + name_length]).decode()
        at += 4 + name_length
        (data_length,) = struct.unpack_from("<Q", buffer, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise Damaged("its head is invalid") from error
    if length is not None and data_length != length - CHUNK_HEAD_BYTES - name_length:
        raise Damaged(
            f"its two lengths do not agree: {length} bytes for the record, {data_length} for the data in it"
        )
    return ChunkHead(start_ns, end_ns, size, crc, compression, at + 8, data_length)


def unpack_chunk(head: ChunkHead, data: bytes) -> bytes:
    """Unpack the records of a chunk and verify their checksum.

    Raises:
        Damaged: They cannot be unpacked, or the checksum is wrong.
        BagError: The compression is not supported, which is not damage.
    """
    records = data if not head.compression else _unpacked(head.compression, data)
    if head.crc:
        if (found := zlib.crc32(records)) != head.crc:
            raise Damaged(f"its checksum is {head.crc:08x}, that of its content {found:08x}")
    elif len(records) != head.size:
        raise Damaged(f"it claims {head.size} bytes, but it has {len(records)}")
    return records


def _unpacked(compression: str, data: bytes) -> bytes:
    try:
        if compression == "lz4":
            import lz4.frame

            found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=MOST_BYTES + 1)
        elif compression == "zstd":
            import zstandard

            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                found = stream.read(MOST_BYTES + 1)
        else:
            raise BagError(f"expected a compression of lz4, zstd or none; got {compression!r:.80}")
    except ImportError as error:
        raise BagError(
            f"the bag is compressed with {compression}, which is not installed: pip install {error.name}"
        ) from error
    except NONSENSE as error:
        raise Damaged(f"its content cannot be unpacked ({error!s:.80})") from error
    if len(found) > MOST_BYTES:
        raise Damaged(f"unpacked it has more than {MOST_BYTES} bytes")
    return bytes(found)


def records_of(data: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the body of every record in a chunk."""
    at, limit = 0, len(data)
    while at < limit:
        opcode, body, end = record_at(data, at, limit)
        if opcode == Opcode.MESSAGE and end - body < MESSAGE_HEAD.size:
            raise Damaged(f"a message in it has {end - body} bytes, fewer than its own head")
        yield opcode, body, end
        at = end


def parse(kind: Any, body: bytes) -> Any:
    """Parse a record of a class of the library (schema, channel, metadata, ...), which must use the whole body."""
    stream = ReadDataStream(io.BytesIO(body))
    try:
        record = kind.read(stream)
    except NONSENSE as error:
        raise Damaged(f"a {kind.__name__.lower()} is invalid") from error
    if stream.count != len(body):
        raise Damaged(f"a {kind.__name__.lower()} has {len(body)} bytes, its content {stream.count}")
    return record


def checked_attachment(body: bytes) -> tuple[Attachment, bool]:
    """Parse an attachment and verify its checksum. Returns the attachment, and whether it has a checksum."""
    record = parse(Attachment, body)
    crc = int.from_bytes(body[-4:], "little")
    if crc and (found := zlib.crc32(memoryview(body)[:-4])) != crc:
        raise Damaged(
            f"the checksum of the attachment {record.name} is {crc:08x}, that of its content {found:08x}"
        )
    return record, bool(crc)


def index_entries(body: bytes) -> tuple[int, list[tuple[int, int]]]:
    """Parse a message index: channel, and log time and offset of each message."""
    if len(body) < 6:
        raise Damaged("a message index ends in its head")
    channel_id, length = struct.unpack_from("<HI", body)
    if length != len(body) - 6 or length % 16:
        raise Damaged("a message index is invalid")
    numbers = struct.unpack_from(f"<{length // 8}Q", body, 6)
    return channel_id, list(zip(numbers[::2], numbers[1::2], strict=True))
