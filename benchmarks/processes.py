"""Processes that a benchmark started, and how they are ended."""

from __future__ import annotations

import signal
import subprocess
from typing import Any


def end(process: subprocess.Popen[Any], patience_s: float = 20.0) -> None:
    """Ask a process that runs to end, as Ctrl-C does, and kill it if it does not within its time [s]."""
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
