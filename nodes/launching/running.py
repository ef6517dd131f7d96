"""Running launches of this user. Imports little, because ``advnerf disarm`` waits for it."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from nodes.runtime.paths import lock_path, private_folder, socket_path, user_folder, user_folders
from nodes.runtime.topics import STATUS_PREFIX


def active_launches() -> list[dict[str, Any]]:
    """Running launches of this user on this host: name, run_dir, pid, and cwd, the folder in which it was started."""
    found = []
    for card in sorted(card for folder in user_folders() for card in (folder / "active").glob("*.json")):
        try:
            launch = read_json(card)
            if is_running(Path(launch["run_dir"])):
                found.append(launch)
        except (OSError, ValueError, KeyError):
            continue  # it ended while we looked
    return found


def is_running(run_dir: Path) -> bool:
    """Whether a launch is running in a run folder."""
    return _is_held(run_dir / "launch.lock")


def has_ended(run_dir: Path) -> bool:
    """Whether neither a launch nor any node of this host is left in a run folder, by the locks that end with their processes."""
    # Of its status alone: a command that asks for something holds the lock of its own topic.
    any_status = _status_lock(run_dir, "*")
    return not is_running(run_dir) and not any(map(_is_held, any_status.parent.glob(any_status.name)))


def is_alive(run_dir: Path, name: str) -> bool:
    """Whether a node of this host runs in a run folder, by the lock of its status."""
    return _is_held(_status_lock(run_dir, name))


def _status_lock(run_dir: Path, name: str) -> Path:
    return lock_path(socket_path(run_dir, STATUS_PREFIX + name))


def _is_held(file: Path) -> bool:
    if not file.exists():
        return False
    with open(file, encoding="ascii") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def leave_card(name: str, run_dir: Path) -> Path:
    """Note a launch, so that `active_launches` finds it. Returns the file to remove at its end."""
    card = private_folder(user_folder() / "active") / f"{os.getpid()}-{run_dir.name}.json"
    write_atomically(
        card, json.dumps({"name": name, "run_dir": str(run_dir), "pid": os.getpid(), "cwd": os.getcwd()})
    )
    return card
