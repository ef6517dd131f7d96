"""Places of this user: configuration, data, caches, and private temporary folders; and paths that every library can open."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal

from advnerf_core.errors import AdvnerfError

_OF_HOME = {
    "cache": ("XDG_CACHE_HOME", ".cache"),
    "config": ("XDG_CONFIG_HOME", ".config"),
    "data": ("XDG_DATA_HOME", ".local/share"),
}


class PlaceError(AdvnerfError):
    """A place that is needed does not exist, belongs to somebody else, or has a name that cannot be used."""


def user_place(kind: Literal["cache", "config", "data"]) -> Path:
    """Folder of advnerf among this user's files; it need not exist.

    Raises:
        PlaceError: The user has no home, as a service account or a container's user may.
    """
    variable, below = _OF_HOME[kind]
    if chosen := os.environ.get(variable):
        return Path(chosen) / "advnerf"
    return expanded(Path("~") / below / "advnerf", variable)


def expanded(path: Path | str, variable: str = "") -> Path:
    """A path with ``~`` as the home of this user.

    Raises:
        PlaceError: There is no home; the message names ``variable`` as a cure beside HOME.
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
    """Folder for this user's caches of advnerf. Where the home cannot be written, a private temporary one takes its place, and that is said.

    Libraries that keep caches (Matplotlib, Mesa), and the processes started from here, are told of it by the environment, so that they
    neither fail nor say it again.

    Raises:
        PlaceError: The temporary folder belongs to somebody else.
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
    """Whether this user can make files in a folder."""
    return os.access(folder, os.W_OK | os.X_OK)


def require_utf8(path: Path | str) -> None:
    """Refuse a path that is no UTF-8, before work whose results could not be read back from there.

    Raises:
        PlaceError: It is not.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        raise PlaceError(
            f"expected a path in UTF-8, got {os.fsencode(path)!r}; rename that folder, or use another one"
        ) from None


def open_tensors(path: Path | str, framework: Literal["pt", "numpy"]) -> Any:
    """``safe_open`` of safetensors, which reads paths in UTF-8 only, and takes others for damaged files.

    Raises:
        PlaceError: The path is no UTF-8.
    """
    from safetensors import safe_open

    require_utf8(path)
    return safe_open(os.fspath(path), framework=framework)
