"""The messages of an MCAP file in the order of their log time, chunk by chunk: several times as fast as the general reader."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from nodes.runtime.bag_file import NONSENSE
from nodes.runtime.errors import BagError

_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
# Before the data of a chunk: start and end time, uncompressed size, CRC; then the name of the compression, then a length.
_CHUNK_HEAD = struct.Struct("<QQQI")
# What a damaged or hostile file may make us ask for.
_MOST_BYTES = 1 << 28


class RawMessage(NamedTuple):
    """A message as the file has it; of two with one log time the one written first comes first."""

    log_ns: int
    chunk_offset: int
    offset: int
    channel_id: int
    sequence: int
    publish_ns: int
    data: bytes


def messages_in_order(
    file: BinaryIO, summary: Summary, channels: Collection[int], start_ns: int = 0
) -> Iterator[RawMessage]:
    """Messages of some channels from a log time on, in order of log time.

    Args:
        file: The file.
        summary: Its summary.
        channels: Ids of the channels that are wanted.
        start_ns: First log time [ns since 1970].
    """
    wanted = frozenset(channels)
    waiting: list[RawMessage] = []
    for index in sorted(summary.chunk_indexes, key=lambda index: (index.message_start_time, index.chunk_start_offset)):
        # Chunks overlap in time where messages came late; what is older than all of this one can go.
        while waiting and waiting[0].log_ns < index.message_start_time:
            yield heappop(waiting)
        indexed = index.message_index_offsets
        if index.message_end_time < start_ns or (indexed and wanted.isdisjoint(indexed)):
            continue
        for message in _messages(_chunk_data(file, index), wanted, index.chunk_start_offset):
            if message.log_ns >= start_ns:
                heappush(waiting, message)
    while waiting:
        yield heappop(waiting)


def _messages(data: bytes, wanted: frozenset[int], chunk_offset: int) -> Iterator[RawMessage]:
    at, end = 0, len(data)
    while at + _RECORD_HEAD.size <= end:
        opcode, length = _RECORD_HEAD.unpack_from(data, at)
        body = at + _RECORD_HEAD.size
        at = body + length
        if at > end:
            raise BagError("a chunk of the bag ends in the middle of a record: the file is damaged")
        if opcode != Opcode.MESSAGE:
            continue
        channel_id, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(data, body)
        if channel_id in wanted:
            payload = data[body + _MESSAGE_HEAD.size : at]
            yield RawMessage(log_ns, chunk_offset, body, channel_id, sequence, publish_ns, payload)


def _chunk_data(file: BinaryIO, index: ChunkIndex) -> bytes:
    """Records of a chunk, unpacked."""
    size = file.seek(0, os.SEEK_END)
    if index.chunk_start_offset + index.chunk_length > size or index.uncompressed_size > _MOST_BYTES:
        raise BagError(
            f"the bag's summary has a chunk of {index.chunk_length} bytes ({index.uncompressed_size} unpacked) at byte "
            f"{index.chunk_start_offset} of {size}: it is damaged"
        )
    file.seek(index.chunk_start_offset)
    record = file.read(index.chunk_length)
    try:
        opcode, _ = _RECORD_HEAD.unpack_from(record)
        start, end, size, crc = _CHUNK_HEAD.unpack_from(record, _RECORD_HEAD.size)
        at = _RECORD_HEAD.size + _CHUNK_HEAD.size
        (name_length,) = struct.unpack_from("<I", record, at)
        compression = record[at + 4 : at + 4 + name_length].decode()
        at += 4 + name_length
        (data_length,) = struct.unpack_from("<Q", record, at)
        data = record[at + 8 : at + 8 + data_length]
        if opcode != Opcode.CHUNK or len(data) != data_length:
            raise BagError(
                f"the bag has no whole chunk at byte {index.chunk_start_offset}, where its summary says so: it is damaged"
            )
        if not compression:
            return data
        if size > _MOST_BYTES:
            raise BagError(f"a chunk of the bag wants {size} bytes; at most {_MOST_BYTES} are unpacked")
        chunk = Chunk(
            compression=compression, data=data, message_start_time=start, message_end_time=end, uncompressed_crc=crc,
            uncompressed_size=size,
        )  # fmt: skip
        stream, length = get_chunk_data_stream(chunk)
        return bytes(stream.read(length))
    except NONSENSE as error:
        raise BagError(f"the chunk at byte {index.chunk_start_offset} of the bag cannot be read: {error}") from error
