"""Paths of the sockets and logs of a run."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from advnerf_core.places import private_folder, temporary_folder
from nodes.runtime.errors import BusError

# sizeof(sockaddr_un.sun_path) is 108 on Linux, including the final zero.
UNIX_PATH_LIMIT = 107
# "status." and a node name of 24 characters.
_LONGEST_NAME = 31
# The resolved launch file in the run folder, which recorders attach to their bag.
RESOLVED_NAME = "launch.resolved.yaml"


def user_folder() -> Path:
    """Short path of this user for files that live as long as a run, under XDG_RUNTIME_DIR or the temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.path.isdir(base) and os.access(base, os.W_OK):
        return private_folder(Path(base) / "advnerf")
    return temporary_folder()


def bus_folder(run_dir: Path) -> Path:
    """Folder of a run's sockets: ``<run_dir>/bus``, or a short link if that path is too long for a socket."""
    run_dir = Path(run_dir).resolve()
    folder = run_dir / "bus"
    if len(os.fsencode(folder)) + 1 + _LONGEST_NAME > UNIX_PATH_LIMIT:
        folder = user_folder() / hashlib.sha256(os.fsencode(run_dir)).hexdigest()[:12]
        if len(os.fsencode(folder)) + 1 + _LONGEST_NAME > UNIX_PATH_LIMIT:
            raise BusError(
                f"expected socket paths of at most {UNIX_PATH_LIMIT} characters, got the longer {folder}; "
                "use a --run-dir under /tmp or a short XDG_RUNTIME_DIR"
            )
    return private_folder(folder)


def socket_path(run_dir: Path, topic: str) -> Path:
    """Path of the Unix socket of a topic."""
    name = topic.strip("/").replace("/", ".")
    if len(name) > _LONGEST_NAME:
        raise BusError(f"expected a topic name of at most {_LONGEST_NAME} characters, got {topic!r}")
    return bus_folder(run_dir) / name


def lock_path(socket: Path) -> Path:
    """Lock file next to a socket. A status publisher touches it at every status, so that the last status's age is known."""
    return socket.with_name(socket.name + ".lock")
