"""Orderly termination on SIGTERM."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def ends_in_order() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C, so that open resources, such as a CARLA world or a live launch, are closed first."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
