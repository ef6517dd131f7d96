"""Index entries of a bag's chunks while it is being written: on disk, so that hours of recording take no more memory than minutes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import ChunkIndex

_HEAD_BYTES = 9  # opcode and length of a record


class SpooledIndexes:
    """Stands in for the list in which an MCAP writer keeps its chunk indexes until it writes its summary.

    Args:
        folder: Folder of the bag; the spool is a nameless file there, gone with the process.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (it lives as long as the bag is open)
        self._builder = RecordBuilder()
        self._count = 0
        self._in_memory: list[ChunkIndex] = []

    def append(self, index: ChunkIndex) -> None:
        """Keep one more; in memory from the moment at which the disk is full, so that the bag can still be finished."""
        self._count += 1
        if not self._in_memory:
            index.write(self._builder)
            try:
                self._file.write(self._builder.end())
                return
            except OSError:
                pass
        self._in_memory.append(index)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[ChunkIndex]:
        self._file.seek(0)
        stream = ReadDataStream(self._file)
        for _ in range(self._count - len(self._in_memory)):
            stream.read(_HEAD_BYTES)
            yield ChunkIndex.read(stream)
        self._file.seek(0, 2)
        yield from self._in_memory

    def close(self) -> None:
        """Give the disk space back."""
        self._file.close()
