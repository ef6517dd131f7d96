"""Paths of the sockets and logs of a run."""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from pathlib import Path

from nodes.runtime.errors import BusError

# sizeof(sockaddr_un.sun_path) is 108 on Linux, including the final zero.
UNIX_PATH_LIMIT = 107
# "status." and a node name of 24 characters.
_LONGEST_NAME = 31
# The resolved launch file in the run folder, which recorders attach to their bag.
RESOLVED_NAME = "launch.resolved.yaml"


def private_folder(path: Path) -> Path:
    """Create a folder that only this user may enter. A folder of another user is refused."""
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise BusError(
            f"expected {path} to belong to user {os.getuid()}, but it belongs to user {found.st_uid}; remove it"
        )
    if stat.S_IMODE(found.st_mode) & 0o077:
        path.chmod(0o700)
    return path


def user_folder() -> Path:
    """Short path of this user for files that live as long as a run, under XDG_RUNTIME_DIR or the temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.path.isdir(base) and os.access(base, os.W_OK):
        return private_folder(Path(base) / "advnerf")
    return private_folder(Path(tempfile.gettempdir()) / f"advnerf-{os.getuid()}")


def user_folders() -> list[Path]:
    """All folders that `user_folder` may have returned to other processes of this user, whose environment may be another one."""
    base = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
    candidates = (Path(base) / "advnerf", Path(tempfile.gettempdir()) / f"advnerf-{os.getuid()}")
    return [folder for folder in candidates if _is_ours(folder)]


def _is_ours(folder: Path) -> bool:
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()


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
