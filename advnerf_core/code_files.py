"""Users' code: hashes of its files and of the versions of the packages that it imports, and the line that raised an error.

Two rules. The hash of a plug-in ``file.py`` includes the modules beside it that it imports, directly or through others. The hash of a module
includes all Python files of its package; without a package, the files of its folder.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import EntryPoint, packages_distributions, version
from pathlib import Path

from advnerf_core.files import sha256_of

_CACHE = "__pycache__"
# This project's own code counts by the versions in keys, even for a plug-in beside it.
_OURS = {"advnerf_core", "calibration", "hardware", "nodes"}
_LARGE_BYTES = 1 << 20
_TRIES = 5
_OUR_FOLDERS = tuple(str(Path(__file__).parents[1] / name) + os.sep for name in _OURS)
_OF_NO_USER = (
    *(sysconfig.get_paths()[name] + os.sep for name in ("stdlib", "purelib", "platlib")),
    *_OUR_FOLDERS,
)


def modules_beside(file: Path) -> list[Path]:
    """Python files beside a file that it imports, directly or through others; for a package all its files. Sorted, without the file."""
    found, waiting = {file}, [file]
    while waiting:
        for name in _imported(waiting.pop()) - _OURS:
            for each in _files_of_module(file.parent, name):
                if each not in found:
                    found.add(each)
                    waiting.append(each)
    return sorted(found - {file})


def line_of_a_user(error: BaseException) -> str:
    """``file.py:line`` of the innermost call that is in neither this software nor a library; empty if there is none."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if _is_a_users(frame.filename):
            return f"{frame.filename}:{frame.lineno}"
    return ""


def was_raised_by_a_user(error: BaseException) -> bool:
    """Whether a user's code, or a library that it called, raised an error, and not this software."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename.startswith(_OUR_FOLDERS):
            return False
        if _is_a_users(frame.filename):
            return True
    return False


def _is_a_users(file: str) -> bool:
    return os.path.isfile(file) and not file.startswith(_OF_NO_USER)


def file_sha256(file: Path) -> str:
    """Hash of a ``file.py`` and of the modules beside it that it imports; of a file that imports none, the hash of its bytes."""
    digest = hashlib.sha256(file.read_bytes())
    _add_files(digest, file.parent, modules_beside(file))
    return digest.hexdigest()


def entry_point_sha256(entry: EntryPoint) -> str:
    """Hash of an entry point's code: its package's name and version, and all files of the package."""
    named = f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else ""
    digest = hashlib.sha256(f"{entry.value} {named}".encode())
    for folder, files in _located(entry.module):
        _add_files(digest, folder, files)
    return digest.hexdigest()


def module_sha256(module: str) -> str:
    """Hash of the Python files of a module's package (or folder), and of the versions of the packages that they import.

    Raises:
        ImportError: No file of the module is found.
    """
    digest, own, imported = hashlib.sha256(), set[str](), set[str]()
    located = list(_located(module))
    if not any(files for _, files in located):
        raise ImportError(f"found no file of a module {module}")
    for folder, files in located:
        python = [file for file in files if file.suffix == ".py"]
        _add_files(digest, folder, python or files)  # a module may be compiled
        own |= {file.relative_to(folder).parts[0].removesuffix(".py") for file in python}
        imported |= {name for file in python for name in _imported(file)}
    for name in sorted(_versions(imported - own)):
        digest.update(f"\0{name}".encode())
    return digest.hexdigest()


def _located(module: str) -> Iterator[tuple[Path, list[Path]]]:
    """Folders with a module's code, each with its files: of its package, or of its folder without a package."""
    try:
        spec = importlib.util.find_spec(module.partition(".")[0])
    except ValueError:  # a module that was created in memory has none
        spec = None
    if spec is None:
        return
    if spec.submodule_search_locations is not None:
        for place in sorted(spec.submodule_search_locations):
            yield Path(place).parent, _files_below(Path(place))
    elif spec.origin is not None and (file := Path(spec.origin)).is_file():
        yield file.parent, _flat_files(file)


def _flat_files(file: Path) -> list[Path]:
    """Python files of a module without a package: of its distribution if it is installed, else of its folder."""
    brought = _packages_by_module() if file.parent.name.endswith("-packages") else {}
    packages = set(brought.get(file.stem, ()))
    if not packages:
        return sorted({file, *file.parent.glob("*.py"), *modules_beside(file)})
    tops = [top for top, owners in brought.items() if not packages.isdisjoint(owners)]
    return sorted({file, *(each for top in tops for each in _files_of_module(file.parent, top))})


@lru_cache(maxsize=1)
def _packages_by_module() -> Mapping[str, list[str]]:
    return packages_distributions()


def _files_of_module(folder: Path, name: str) -> list[Path]:
    """Python files of a module or package of this name in a folder; empty if it is not there."""
    package = [file for file in _files_below(folder / name) if file.suffix == ".py"]
    return [*package, file] if (file := folder / f"{name}.py").is_file() else package


def _files_below(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.rglob("*")
        if _CACHE not in path.parts and path.suffix != ".pyc" and path.is_file()
    )


def _add_files(digest: hashlib._Hash, folder: Path, files: Iterable[Path]) -> None:
    for file in files:
        state = file.stat()
        large = (
            state.st_size > _LARGE_BYTES
        )  # small files may be saved twice within a tick of the file system's clock
        content = _known_sha256(file, state.st_mtime_ns, state.st_size) if large else sha256_of(file)
        digest.update(f"\0{file.relative_to(folder).as_posix()}\0{content}".encode())


@lru_cache(maxsize=256)
def _known_sha256(file: Path, changed_ns: int, size: int) -> str:
    del changed_ns, size  # part of the cache's key
    return sha256_of(file)


def _imported(file: Path) -> set[str]:
    """Top-level names of the modules that a Python file imports; empty for a file that Python cannot parse."""
    try:
        tree = _parsed(file.read_bytes())
    except (SyntaxError, ValueError):
        return set()  # loading it reports the error
    names = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names - sys.stdlib_module_names


def _parsed(source: bytes) -> ast.Module:
    # Before 3.13, another thread that parses while this one collects garbage makes CPython raise a SystemError: python/cpython#106905.
    for _ in range(_TRIES):
        with suppress(SystemError):
            return ast.parse(source)
    return ast.parse(source)


def _versions(names: Iterable[str]) -> set[str]:
    """``package version`` of each installed package that provides one of these modules; a build's label, such as ``+cpu``, is left out."""
    brought = _packages_by_module()
    packages = {package for name in names for package in brought.get(name, ())}
    return {f"{package} {version(package).partition('+')[0]}" for package in packages}
