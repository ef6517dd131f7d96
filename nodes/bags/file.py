"""Opens MCAP files that may be damaged or malicious: all failures are one kind of error."""

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
def open_bag(path: Path) -> Iterator[BinaryIO]:
    """Open a bag's file for the readers of the format. Their exceptions become one `BagError`."""
    try:
        with open(path, "rb") as file:
            yield file
    except NONSENSE as error:
        what = f"{type(error).__name__} {error}".strip()
        raise BagError(
            f"{path} is damaged and cannot be read ({what:.120}); try advnerf bag repair on a copy"
        ) from error
