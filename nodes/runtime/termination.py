"""Orderly termination on SIGTERM."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any


def wait_or_kill(process: subprocess.Popen[Any], wait_s: float) -> None:
    """Wait for a process that was asked to end; kill it if it does not end within this time [s]."""
    try:
        process.wait(wait_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextlib.contextmanager
def ends_in_order() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C, so that open resources, such as a CARLA world or a live launch, are closed first."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
