"""What keeps the messages of a bag's unfinished chunk: a small file beside it, written message by message.

A chunk reaches the bag only when it is full, so that files stay small and quick to search. Until then its messages are in the
journal, where the death of the recorder cannot take them away; `nodes.bags.repair` puts them into the bag.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# Mark, and the length of the bag when its present chunk was begun.
_HEAD = struct.Struct("<8sQ")
_MARK = b"advnjrn1"
# CRC-32 of all that follows, log time, publish time, sequence, length of the topic, length of the message.
_ENTRY = struct.Struct("<IQQIHI")
_CRC_BYTES = 4
# Held back so that the summaries still fit when the disk is full: those of two parts of 1 GiB take 3 MB.
RESERVE_BYTES, RESERVE_NAME = 8 * 1024 * 1024, ".reserve"


@dataclass(frozen=True)
class Entry:
    """A message that waits for its chunk."""

    topic: str
    cdr: bytes
    log_ns: int
    publish_ns: int
    sequence: int


def journal_of(bag_file: Path) -> Path:
    """Where the journal of a ``.mcap`` file is."""
    return bag_file.with_name(f".{bag_file.name}.journal")


class Journal:
    """Writes a journal.

    Args:
        bag_file: The ``.mcap`` file.
        position: Its length now, where the first chunk will begin.
    """

    def __init__(self, bag_file: Path, position: int) -> None:
        self.path = journal_of(bag_file)
        self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        self._position = -1
        self.restart(position)

    def add(self, entry: Entry) -> None:
        """Note a message."""
        topic = entry.topic.encode()
        lengths = len(topic), len(entry.cdr)
        head = _ENTRY.pack(0, entry.log_ns, entry.publish_ns, entry.sequence & 0xFFFFFFFF, *lengths)[_CRC_BYTES:]
        body = head + topic + entry.cdr
        _write_all(self._descriptor, zlib.crc32(body).to_bytes(_CRC_BYTES, "little") + body)

    def restart(self, position: int) -> None:
        """Forget everything if the bag has grown since, because what was here is in it now."""
        if position != self._position:
            self._position = position
            os.ftruncate(self._descriptor, 0)
            os.lseek(self._descriptor, 0, os.SEEK_SET)
            _write_all(self._descriptor, _HEAD.pack(_MARK, position))

    def close(self) -> None:
        """Let the file go; it stays where it is."""
        os.close(self._descriptor)


def read_journal(bag_file: Path) -> tuple[int, list[Entry]]:
    """Length of the bag when the chunk was begun, and the messages that were to be in it; nothing if there is no journal."""
    try:
        content = journal_of(bag_file).read_bytes()
    except FileNotFoundError:
        return 0, []
    if len(content) < _HEAD.size or not content.startswith(_MARK):
        return 0, []
    return _HEAD.unpack_from(content)[1], list(_entries(content))


def _entries(content: bytes) -> Iterator[Entry]:
    """Whole entries, up to the one that was cut off or damaged."""
    at = _HEAD.size
    while at + _ENTRY.size <= len(content):
        crc, log_ns, publish_ns, sequence, topic_length, cdr_length = _ENTRY.unpack_from(content, at)
        middle = at + _ENTRY.size + topic_length
        end = middle + cdr_length
        if end > len(content) or zlib.crc32(content[at + _CRC_BYTES : end]) != crc:
            return
        topic = content[at + _ENTRY.size : middle].decode("utf-8", "replace")
        yield Entry(topic, content[middle:end], log_ns, publish_ns, sequence)
        at = end


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
