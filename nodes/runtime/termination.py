"""Being asked to end."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def ends_in_order() -> Iterator[None]:
    """Asked to end (SIGTERM), end as after Ctrl-C, so that what is open is closed first: a CARLA server's world, a live graph."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
