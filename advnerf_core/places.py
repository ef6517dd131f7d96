"""Places of this user: configuration, data, caches, and private temporary folders; and paths that all libraries can open."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import Literal

from advnerf_core.errors import AdvnerfError

_OF_HOME = {
    "cache": ("XDG_CACHE_HOME", ".cache"),
    "config": ("XDG_CONFIG_HOME", ".config"),
    "data": ("XDG_DATA_HOME", ".local/share"),
}


class PlaceError(AdvnerfError):
    """A required place does not exist, belongs to another user, or has an unusable name."""


def user_place(kind: Literal["cache", "config", "data"]) -> Path:
    """Folder of advnerf among this user's files; it need not exist.

    Raises:
        PlaceError: The user has no home, like some service accounts and container users.
    """
    variable, below = _OF_HOME[kind]
    if chosen := os.environ.get(variable):
        return Path(chosen) / "advnerf"
    return expanded(Path("~") / below / "advnerf", variable)


def expanded(path: Path | str, variable: str = "") -> Path:
    """A path with ``~`` expanded to this user's home.

    Raises:
        PlaceError: The user has no home; the message suggests setting ``variable`` or HOME.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        other = f" or {variable}" if variable else ""
        raise PlaceError(
            f"expected a home folder of user {os.getuid()} for {path}, found none; set HOME{other} to a folder of this user"
        ) from None


def private_folder(path: Path) -> Path:
    """Create a folder that only this user may enter. A folder of another user is refused."""
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise PlaceError(
            f"expected {path} to belong to user {os.getuid()}, but it belongs to user {found.st_uid}; remove it"
        )
    if stat.S_IMODE(found.st_mode) & 0o077:
        path.chmod(0o700)
    return path


def temporary_path() -> Path:
    """Path of this user's folder among the temporary files; it need not exist."""
    return Path(tempfile.gettempdir()) / f"advnerf-{os.getuid()}"


def temporary_folder() -> Path:
    """Private folder of this user among the temporary files."""
    return private_folder(temporary_path())


def use_writable_cache() -> Path:
    """Folder for this user's caches of advnerf. If the home is not writable, it falls back to a private temporary folder, with a warning.

    The environment passes it on to libraries with caches (Matplotlib, Mesa) and to child processes, so that they
    neither fail nor warn again.

    Raises:
        PlaceError: The temporary folder belongs to another user.
    """
    try:
        folder = user_place("cache")
        folder.mkdir(parents=True, exist_ok=True)
        if is_writable(folder):
            return folder
        trouble = f"{folder} cannot be written"
    except (PlaceError, OSError) as error:
        trouble = str(error)
    caches = private_folder(temporary_folder() / "cache")
    os.environ["XDG_CACHE_HOME"] = str(caches)
    os.environ.setdefault("MPLCONFIGDIR", str(caches / "matplotlib"))
    folder = private_folder(caches / "advnerf")
    print(f"advnerf: caches are in {folder}: {trouble}", file=sys.stderr, flush=True)
    return folder


def is_writable(folder: Path) -> bool:
    """Whether this user can create files in a folder."""
    return os.access(folder, os.W_OK | os.X_OK)


def require_utf8(path: Path | str) -> None:
    """Raise for a path that is not UTF-8, before any work whose results could not be read back from there.

    Raises:
        PlaceError: The path is not UTF-8.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        raise PlaceError(
            f"expected a path in UTF-8, got {os.fsencode(path)!r}; rename that folder, or use another one"
        ) from None
