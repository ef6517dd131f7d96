"""Tells the simulated car from a real one, which only a person may arm.

The simulated car is the controller whose firmware says so, at the end of the pseudo-terminal that the twin of the same run has made.
A name alone is not enough: any controller can be given it.
"""

from __future__ import annotations

import os
import re
import stat
import time
from pathlib import Path
from typing import TextIO

from nodes.runtime.locks import HeldError, hold
from nodes.runtime.paths import bus_folder

TWIN_NAME = "TWIN"
_PEER = re.compile(rf"{TWIN_NAME} firmware \d+\.\d+")
PORT, _LOCK = "vesc", "vesc.lock"
# Major device numbers of Unix 98 pseudo-terminals (Linux, Documentation/admin-guide/devices.txt).
_FIRST_PTS, _LAST_PTS = 136, 143
_CLAIM_TRIES, _CLAIM_WAIT_S = 50, 0.02


def is_twin(peer: str) -> bool:
    """Whether the motor node says that its controller is the twin of this run (see `peer_text`)."""
    return _PEER.fullmatch(peer) is not None


def peer_text(firmware: str, hardware_name: str | None, on_twins_port: bool) -> str:
    """Identity of a controller for ``/motor/sent``. Only the twin of this run satisfies `is_twin`."""
    if hardware_name == TWIN_NAME and on_twins_port:
        return firmware
    return f"{firmware}, not the twin of this run" if is_twin(firmware) else firmware


def claim_twins_port(run_dir: Path) -> TextIO:
    """Declare that ``<run_dir>/vesc`` leads to the pseudo-terminal of this process, until the returned file is closed.

    A link that an earlier twin has left behind is removed.

    Raises:
        HeldError: The twin of another process has declared it.
    """
    for tries_left in reversed(range(_CLAIM_TRIES)):
        try:
            claim = hold(bus_folder(run_dir) / _LOCK)
            break
        except HeldError:
            if not tries_left:
                raise
            time.sleep(_CLAIM_WAIT_S)  # a motor node may be looking
    (run_dir / PORT).unlink(missing_ok=True)
    return claim


def is_twins_port(run_dir: Path, port: str) -> bool:
    """Whether a serial port is the pseudo-terminal that a living twin of this run has made."""
    try:
        mine, twins = os.stat(port), os.stat(run_dir / PORT)
    except OSError:
        return False
    if not (stat.S_ISCHR(mine.st_mode) and _FIRST_PTS <= os.major(mine.st_rdev) <= _LAST_PTS):
        return False
    if mine.st_rdev != twins.st_rdev:
        return False
    try:
        hold(bus_folder(run_dir) / _LOCK).close()
    except HeldError:
        return True
    return False
