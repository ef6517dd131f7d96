"""Paths of the sockets and logs of a run, and of the files that come with advnerf."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from advnerf_core.places import PlaceError, private_folder, temporary_folder, temporary_path
from nodes.runtime.errors import BagError, BusError

# sizeof(sockaddr_un.sun_path) is 108 on Linux, including the final zero.
UNIX_PATH_LIMIT = 107
# "status." and a node name of 24 characters.
_LONGEST_NAME = 31
# The resolved launch file in the run folder, which recorders attach to their bag.
RESOLVED_NAME = "launch.resolved.yaml"


def shipped(name: str) -> Path:
    """File or folder that comes with advnerf, such as ``launch`` or ``calibration/twin``; read-only.

    A checkout has it beside its packages, a wheel in ``nodes/shipped`` (setup.py).
    """
    package = Path(__file__).parents[1]
    inside = package / "shipped" / name
    return inside if inside.exists() else package.parent / name


def named_file(name: str | Path, *kinds: str) -> Path:
    """File that a command was given: a path, or a name like ``green_screen`` of one in ``launch`` here, or of one that is shipped.

    Args:
        name: Path or name.
        kinds: Endings without ``.yaml``, such as ``launch``, in the order in which they are tried.

    Raises:
        PlaceError: No such file exists; the message lists the names.
    """
    path = Path(name)
    if path.is_file():
        return path
    folders = Path("launch"), shipped("launch")
    if path.name == str(name):
        for file in (folder / f"{name}.{kind}.yaml" for folder in folders for kind in kinds):
            if file.is_file():
                return file
    known = sorted(
        {
            file.name.split(".")[0]
            for folder in folders
            for kind in kinds
            for file in folder.glob(f"*.{kind}.yaml")
        }
    )
    raise PlaceError(
        f"expected a file {' or '.join(f'*.{kind}.yaml' for kind in kinds)}, found none at {name}; correct the path, or give one of the names "
        f"{', '.join(known)} (advnerf experiment init copies these files to edit)"
    )


def user_folder() -> Path:
    """Short path of this user for files that live as long as a run, under XDG_RUNTIME_DIR or the temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.path.isdir(base) and os.access(base, os.W_OK):
        return private_folder(Path(base) / "advnerf")
    return temporary_folder()


def user_folders() -> list[Path]:
    """All folders that `user_folder` may have returned to other processes of this user, whose environment may be another one."""
    base = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
    candidates = (Path(base) / "advnerf", temporary_path())
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
                "use a --folder under /tmp or a short XDG_RUNTIME_DIR"
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


def require_new(folder: Path) -> None:
    """Refuse a folder for a new bag that holds anything.

    Raises:
        BagError: It exists, and is not empty.
    """
    if folder.is_file() or (folder.exists() and any(folder.iterdir())):
        raise BagError(f"{folder} exists and is not empty; record to another folder, or remove it")
