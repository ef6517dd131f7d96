"""Reads MCAP files that may be damaged or malicious: reads are bounded, and all failures are one kind of error."""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import McapError
from zstandard import ZstdError

from nodes.runtime.errors import BagError

# Exceptions that the readers of the format raise for invalid bytes.
NONSENSE = (
    McapError, ZstdError, ValueError, KeyError, IndexError, TypeError, RuntimeError, OverflowError, MemoryError, EOFError,
    struct.error,
)  # fmt: skip


class BoundedFile:
    """A file whose reads are limited to its size, because a length in a damaged file may have any value."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.name = str(file.name)
        self._size = os.fstat(file.fileno()).st_size

    def read(self, size: int = -1) -> bytes:
        """Read ``size`` bytes, or the rest of the file if it is shorter."""
        left = max(0, self._size - self._file.tell())
        return self._file.read(left if size < 0 else min(size, left))

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to an offset. An offset outside the file is an error."""
        place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._file.tell(), os.SEEK_END: self._size}[whence]
        if not 0 <= place <= self._size:
            raise EOFError(f"byte {place} of {self._size}")
        return self._file.seek(place)

    def tell(self) -> int:
        """Current offset."""
        return self._file.tell()

    def seekable(self) -> bool:
        """Return True."""
        return True


@contextmanager
def mapped(path: Path) -> Iterator[Any]:
    """Map the bytes of a file into memory. No view of them may outlive the context."""
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            yield b""
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            yield buffer


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Open a bag's file for the readers of the format. Their exceptions become one `BagError`."""
    try:
        with open(path, "rb") as file:
            yield BoundedFile(file)
    except NONSENSE as error:
        what = f"{type(error).__name__} {error}".strip()
        raise BagError(
            f"{path} is damaged and cannot be read ({what:.120}); try advnerf bag repair on a copy"
        ) from error
