"""The folder of compiled kernels: a separate one for each state of the kernels' sources.

Numba keeps a compiled kernel until its own file changes. A kernel that calls one of another file is not compiled again when that file
changes, so it would keep computing with the old one. Here a change of any file with kernels gives all kernels a new folder.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from pathlib import Path

from advnerf_core.places import PlaceError, is_writable, use_writable_cache

_PACKAGE = Path(__file__).parent
_PREFIX = "advnerf-"
_VARIABLE = "NUMBA_CACHE_DIR"
_KEPT = 3  # folders of earlier sources that are kept, as other checkouts may share the place


def use_own_folder(package: Path = _PACKAGE) -> Path:
    """Tell numba, in this process and in child processes, to store compiled kernels in the folder of their current sources.

    It lies below ``NUMBA_CACHE_DIR``, or in the package's ``__pycache__``, or in the user's cache where that cannot be written, or in a
    private temporary folder where that cannot either. Call it before a kernel is decorated.

    Args:
        package: Folder with the kernels' sources.

    Returns:
        The folder.

    Raises:
        PlaceError: The folder cannot be written.
    """
    folder = _base(package) / f"{_PREFIX}{sources_digest(package)}"
    try:
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            _remove_old(folder)
    except OSError as error:
        raise PlaceError(
            f"expected to keep compiled kernels in {folder}: {error}; set {_VARIABLE} to a folder of this user"
        ) from error
    os.environ[_VARIABLE] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder


def sources_digest(package: Path) -> str:
    """Hash of all Python files below a folder that hold kernels, or what kernels are made of."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if b"numba" in content or b"llvmlite" in content:
            digest.update(f"{path.relative_to(package).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]


def _base(package: Path) -> Path:
    if chosen := os.environ.get(_VARIABLE):
        # A child process inherits our folder.
        return Path(chosen).parent if Path(chosen).name.startswith(_PREFIX) else Path(chosen)
    own = package / "__pycache__"
    return own if is_writable(own if own.is_dir() else package) else use_writable_cache() / "kernels"


def _remove_old(folder: Path) -> None:
    others = [each for each in folder.parent.glob(f"{_PREFIX}*") if each != folder]
    for old in sorted(others, key=lambda each: each.stat().st_mtime)[:-_KEPT]:
        shutil.rmtree(old, ignore_errors=True)
