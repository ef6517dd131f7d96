"""Running launches of this user. Imports little, because ``advnerf disarm`` waits for it."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from nodes.runtime.paths import bus_folder, private_folder, user_folder, user_folders


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
    locks = [run_dir / "launch.lock", *bus_folder(run_dir).glob("*.lock")]
    return not any(_is_held(lock) for lock in locks if lock.exists())


def _is_held(file: Path) -> bool:
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
