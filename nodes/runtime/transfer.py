"""File transfer over the bus: the sender cuts a file into pieces; the receiver joins and verifies them.

A receiver gets either the complete file with the announced hash, or no file. Pieces arrive in order from one publisher. Any other
piece ends the transfer, and the next one starts at piece 0. The sender repeats a file, so a lost piece only costs time.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from nodes.runtime.messages import header, types

# Small enough that a full queue of 16 messages fits into the memory of the car's computer.
CHUNK_BYTES = 256 * 1024
LARGEST_BYTES = 64 * 1024 * 1024


def chunk_messages(content: bytes, name: str, stamp_ns: int) -> list[Any]:
    """Cut a file of 1 byte to 64 MiB into ``FileChunk`` messages."""
    if not 0 < len(content) <= LARGEST_BYTES:
        raise ValueError(f"expected a file of 1 to {LARGEST_BYTES} bytes, got {len(content)}")
    sha256 = hashlib.sha256(content).hexdigest()
    starts = range(0, len(content), CHUNK_BYTES)
    return [
        types.FileChunk(
            header=header(stamp_ns),
            name=name,
            sha256=sha256,
            size_bytes=len(content),
            index=index,
            count=len(starts),
            data=np.frombuffer(content[start : start + CHUNK_BYTES], dtype=np.uint8),
        )
        for index, start in enumerate(starts)
    ]


class FileSender:
    """Sends the pieces of a file, one a tick: some rounds, and one more for each receiver that begins to listen.

    Args:
        pause_ns: Time between two rounds [ns].
    """

    def __init__(self, chunks: list[Any], rounds: int, pause_ns: int) -> None:
        self._chunks, self._rounds, self._pause_ns = chunks, rounds, pause_ns
        self._index, self._due_ns, self._listeners = 0, 0, 0

    def next(self, mono_ns: int, listeners: int = 0) -> Any | None:
        """Return the piece that is due, or None."""
        if listeners > self._listeners:
            self._rounds = max(self._rounds, 1 + (self._index > 0))
        self._listeners = listeners
        if self._rounds == 0 or mono_ns < self._due_ns:
            return None
        piece = self._chunks[self._index]
        self._index = (self._index + 1) % len(self._chunks)
        if self._index == 0:
            self._rounds -= 1
            self._due_ns = mono_ns + self._pause_ns
        return piece


@dataclass(frozen=True)
class ReceivedFile:
    """A complete, verified file.

    Attributes:
        name: Name that the sender gave the file.
    """

    name: str
    sha256: str
    content: bytes


class Assembler:
    """Assembles one file at a time."""

    def __init__(self) -> None:
        self._key: tuple[int, str, str, int, int] | None = None
        self._parts: list[bytes] = []

    @property
    def receiving(self) -> bool:
        """Whether a transfer is in progress."""
        return self._key is not None

    def add(self, chunk: Any, instance_id: int) -> tuple[ReceivedFile | None, str]:
        """Add a piece.

        Returns:
            The file if this was its last piece, else None; and the error of a transfer, or an empty text.
        """
        key = (instance_id, str(chunk.name), str(chunk.sha256), int(chunk.size_bytes), int(chunk.count))
        index, trouble = int(chunk.index), ""
        if self._key is None and index > 0:
            # The rest of a transfer that was aborted or began before the subscription; the file is sent again.
            return None, ""
        if self._key is not None and (key != self._key or index != len(self._parts)):
            came = f"piece {index + 1} of {key[4]} of {key[1]}"
            trouble = f"expected piece {len(self._parts) + 1} of {self._key[4]} of {self._key[1]}, got {came}; waiting for the next transfer"
            self._forget()
            if index > 0:
                return None, trouble
        if self._key is None:
            if problem := _announcement_problem(key):
                return None, problem
            self._key = key
        return self._append(chunk, trouble)

    def _append(self, chunk: Any, trouble: str) -> tuple[ReceivedFile | None, str]:
        assert self._key is not None
        _, name, sha256, size, count = self._key
        expected = CHUNK_BYTES if len(self._parts) < count - 1 else size - CHUNK_BYTES * (count - 1)
        data = bytes(chunk.data)
        if len(data) != expected:
            self._forget()
            piece = int(chunk.index) + 1
            return None, f"expected {expected} bytes in piece {piece} of {name}, got {len(data)}"
        self._parts.append(data)
        if len(self._parts) < count:
            return None, trouble
        content = b"".join(self._parts)
        self._forget()
        if hashlib.sha256(content).hexdigest() != sha256:
            return (
                None,
                f"expected {name} with the announced hash {sha256[:12]}, got other bytes; waiting for the next transfer",
            )
        return ReceivedFile(name, sha256, content), trouble

    def _forget(self) -> None:
        self._key, self._parts = None, []


def _announcement_problem(key: tuple[int, str, str, int, int]) -> str:
    _, name, _, size, count = key
    if not 0 < size <= LARGEST_BYTES or count != -(-size // CHUNK_BYTES):
        return f"expected {name} in pieces of {CHUNK_BYTES} bytes, at most {LARGEST_BYTES}, got {size} bytes in {count} pieces"
    return ""
