"""File locks that end with their process. The error about a held lock names its owner."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from nodes.runtime.errors import ConfigError, RuntimeFault


class HeldError(RuntimeFault, OSError):
    """Another process holds the lock.

    Attributes:
        owner: Process id that the owner wrote into the lock file.
    """

    def __init__(self, owner: str) -> None:
        super().__init__(f"the lock is held by process {owner}")
        self.owner = owner


def hold(path: Path) -> TextIO:
    """Take the lock and write the process id into its file. The lock is held until the returned file is closed.

    A file that another user made, as of a lock of the whole machine, can be locked without being written.

    Raises:
        HeldError: Another process holds it.
    """
    try:
        lock = open(path, "a+", encoding="ascii")  # noqa: SIM115 - kept open: it is the lock
    except PermissionError:
        lock = open(path, encoding="ascii")  # noqa: SIM115
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        owner = lock.read().strip() or "unknown"
        lock.close()
        raise HeldError(owner) from None
    if lock.writable():
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
    return lock


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Make a folder and hold its lock. A new folder in which an error has left nothing else is removed.

    Raises:
        ConfigError: Another process works in it.
    """
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(folder / ".lock")
    except HeldError as error:
        raise ConfigError(f"{folder} is in use by process {error.owner}: wait for it, or stop it") from None
    with lock:
        try:
            yield
        except BaseException:
            if is_new and os.listdir(folder) == [".lock"]:
                shutil.rmtree(folder, ignore_errors=True)
            raise
