"""The journal of a bag: a small file next to it with the messages of the unfinished chunk.

A chunk is written to the bag when it is full, so that files stay small and fast to search. Until then, its messages are in the
journal, which survives if the recorder is killed. `nodes.bags.repair` adds them to the bag.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from nodes.bags.info import BagMessage

# Signature, and the length of the bag at the start of its current chunk.
_HEAD = struct.Struct("<8sQ")
_MARK = b"advnjrn1"
# CRC-32 of the following bytes, log time, publish time, sequence, length of the topic, length of the message.
_ENTRY = struct.Struct("<IQQIHI")
_CRC_BYTES = 4
# Reserved space for the summaries when the disk is full: the summaries of two parts of 1 GiB take 3 MB.
RESERVE_BYTES, RESERVE_NAME = 8 * 1024 * 1024, ".reserve"


def journal_of(bag_file: Path) -> Path:
    """Path of the journal of a ``.mcap`` file."""
    return bag_file.with_name(f".{bag_file.name}.journal")


class Journal:
    """Writes a journal.

    Args:
        bag_file: The ``.mcap`` file.
        position: Current length of the file, where the first chunk will begin.
    """

    def __init__(self, bag_file: Path, position: int) -> None:
        self.path = journal_of(bag_file)
        self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        self._closed = False
        self._position = -1
        self.restart(position)

    def add(self, entry: BagMessage) -> None:
        """Append a message."""
        topic = entry.topic.encode()
        lengths = len(topic), len(entry.cdr)
        head = _ENTRY.pack(0, entry.log_ns, entry.publish_ns, entry.sequence & 0xFFFFFFFF, *lengths)[
            _CRC_BYTES:
        ]
        body = head + topic + entry.cdr
        _write_all(self._descriptor, zlib.crc32(body).to_bytes(_CRC_BYTES, "little") + body)

    def restart(self, position: int) -> None:
        """Empty the journal if the bag has grown, because its messages are then in the bag."""
        if position != self._position:
            self._position = position
            os.ftruncate(self._descriptor, 0)
            os.lseek(self._descriptor, 0, os.SEEK_SET)
            _write_all(self._descriptor, _HEAD.pack(_MARK, position))

    def close(self) -> None:
        """Close the file without removing it. May be called repeatedly: by then its number may be another file's."""
        if not self._closed:
            self._closed = True
            os.close(self._descriptor)


def read_journal(bag_file: Path) -> tuple[int, list[BagMessage]]:
    """Read the length of the bag at the start of the chunk, and the chunk's messages; no messages without a journal."""
    try:
        content = journal_of(bag_file).read_bytes()
    except FileNotFoundError:
        return 0, []
    if len(content) < _HEAD.size or not content.startswith(_MARK):
        return 0, []
    return _HEAD.unpack_from(content)[1], list(_entries(content))


def _entries(content: bytes) -> Iterator[BagMessage]:
    """Yield the intact entries up to the first cut or damaged one."""
    at = _HEAD.size
    while at + _ENTRY.size <= len(content):
        crc, log_ns, publish_ns, sequence, topic_length, cdr_length = _ENTRY.unpack_from(content, at)
        middle = at + _ENTRY.size + topic_length
        end = middle + cdr_length
        if end > len(content) or zlib.crc32(content[at + _CRC_BYTES : end]) != crc:
            return
        topic = content[at + _ENTRY.size : middle].decode("utf-8", "replace")
        yield BagMessage(topic, content[middle:end], log_ns, publish_ns, sequence)
        at = end


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
