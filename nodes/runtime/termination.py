"""Orderly termination on signals: on SIGTERM, and on a closed terminal."""

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


def ending_signals() -> tuple[signal.Signals, ...]:
    """SIGTERM, and what a closed terminal, a lost ssh connection and Ctrl-\\ send; without the signals that this process must ignore (nohup)."""
    others = (signal.SIGHUP, signal.SIGQUIT)
    return (signal.SIGTERM, *(each for each in others if signal.getsignal(each) is not signal.SIG_IGN))


@contextlib.contextmanager
def ends_in_order() -> Iterator[None]:
    """Treat `ending_signals` like Ctrl-C, so that open resources, such as a CARLA world or a live launch, are closed first."""
    before = {
        number: signal.signal(number, lambda number, frame: sys.exit(128 + number))
        for number in ending_signals()
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
