"""The first word of ``advnerf disarm``. Imports only the standard library, because the other imports can take seconds."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

# A command has this long since the start of its process to import its code and to ask.
_FIRST_WORD_S = 0.9
_TEXT = (
    "error: NOT CONFIRMED: nothing is known yet, and the car may be driving. Use the e-stop or cut the power."
    " Still asking (Ctrl-C gives up)"
)
_timer: threading.Timer | None = None


def promise_first_word() -> None:
    """Say NOT CONFIRMED if the command says nothing in time, however slow the computer is."""
    global _timer
    if _timer is None:
        _timer = threading.Timer(max(0.0, _FIRST_WORD_S - _process_age_s()), _say)
        _timer.daemon = True
        _timer.start()


def spoken() -> None:
    """Note that the command has said something."""
    if _timer is not None:
        _timer.cancel()


def _say() -> None:
    print(_TEXT, file=sys.stderr, flush=True)


def _process_age_s() -> float:
    """Time since this process was started [s]. Source: proc(5), field 22 of ``/proc/self/stat``."""
    try:
        fields = Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return 0.0
