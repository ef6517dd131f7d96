"""Locks that die with their process: whoever holds one is named to whoever wants it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import TextIO

from nodes.runtime.errors import RuntimeFault


class HeldError(RuntimeFault, OSError):
    """Another process holds the lock.

    Attributes:
        owner: Its process id, as it wrote it.
    """

    def __init__(self, owner: str) -> None:
        super().__init__(f"held by process {owner}")
        self.owner = owner


def hold(path: Path) -> TextIO:
    """Take the lock and write our process id into its file; it is held until the file returned is closed.

    Raises:
        HeldError: Another process holds it.
    """
    lock = open(path, "a+", encoding="ascii")  # noqa: SIM115 - kept open: it is the lock
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        owner = lock.read().strip() or "unknown"
        lock.close()
        raise HeldError(owner) from None
    lock.truncate(0)
    lock.write(f"{os.getpid()}\n")
    lock.flush()
    return lock
