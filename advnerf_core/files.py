"""Writes files so that readers, and crashes, never leave half of one, and the same content gives the same bytes."""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from io import BufferedRandom
from pathlib import Path
from typing import Any, Literal

from advnerf_core.places import PlaceError, require_utf8

PART = ".part"
"""End of the name of an output while it is written."""


def write_atomically(path: Path, data: str | bytes, *, synced: bool = True) -> None:
    """Write a whole file or nothing: under a temporary name first, then renamed over ``path``. Several that write it at once wait for each other.

    Args:
        synced: Whether to wait for the disk. A file that is not waited for may be lost in a power cut.
    """
    require_utf8(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + PART)
    with _locked(temporary) as stream:
        try:
            stream.truncate()  # what a killed writer has left
            stream.write(data.encode() if isinstance(data, str) else data)
            stream.flush()
            if synced:
                os.fsync(stream.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def _locked(temporary: Path) -> BufferedRandom:
    """A temporary file, open, that no other writer has; one that was renamed while it was waited for is another file."""
    while True:
        stream = os.fdopen(os.open(temporary, os.O_RDWR | os.O_CREAT, 0o666), "r+b")
        with suppress(OSError):  # of a file system without locks
            fcntl.flock(stream, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(stream.fileno()), os.stat(temporary)):
                return stream
        stream.close()


def refuse_overwriting(inputs: Iterable[Path | None], outputs: Iterable[Path]) -> None:
    """Refuse outputs that would replace an input, under any name, a file in an input folder, a folder, or another output.

    Args:
        inputs: Files and folders that the user gave; None for an option that was not given.
        outputs: Files that will be written.

    Raises:
        PlaceError: An output is one of these.
    """
    given = [each.resolve() for each in inputs if each is not None]
    taken: set[Path] = set()
    for output in outputs:
        file = output.resolve()
        if file.is_dir():
            raise PlaceError(f"expected a file to write, got the folder {output}; add a file name")
        if file in given or (file.exists() and any(file.is_relative_to(each) for each in given)):
            raise PlaceError(
                f"expected an output that replaces nothing that was given, but {output} would be overwritten; choose another --output"
            )
        if file in taken:
            raise PlaceError(
                f"expected names for two files to write, but both would be {output}; give --output another suffix"
            )
        taken.add(file)


def is_plain_name(name: str) -> bool:
    """Whether a name is one of a file alone, on any system, so that a stranger's file cannot have others written elsewhere."""
    return name not in ("", ".", "..") and not any(each in name for each in "/\\\0")


def natural_order(name: str) -> list[tuple[int, str]]:
    """Key that sorts names by the numbers in them: ``9.jpg`` before ``10.jpg``."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def write_json(path: Path, data: Any) -> None:
    """Write an indented JSON value, whole or not at all."""
    write_atomically(path, json.dumps(data, indent=1) + "\n")


def finite_or_none(value: float) -> float | None:
    """A number as JSON can hold it: None, which is its null, for infinity or NaN."""
    return value if math.isfinite(value) else None


def not_writable(path: str | os.PathLike[str], error: OSError) -> str:
    """Text of an error about an output that cannot be made."""
    why = error.strerror or str(error)
    return f"expected a folder that can be written to, got {os.fsdecode(path).removesuffix(PART)} ({why}); give another with -o or --folder"


def sha256_of(file: Path) -> str:
    """SHA-256 of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def with_sorted_header(content: bytes) -> bytes:
    """The same safetensors container with the keys of its header in order: the library's order changes from process to process."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # the tensors stay aligned
    return len(header).to_bytes(8, "little") + header + content[end:]


def write_tensors(
    path: str | os.PathLike[str],
    framework: Literal["torch", "numpy"],
    tensors: dict[str, Any],
    header: dict[str, str],
) -> None:
    """Write a safetensors container, whole or not at all; the same content gives the same bytes."""
    content = import_module(f"safetensors.{framework}").save(tensors, header)
    write_atomically(Path(path), with_sorted_header(content))


def read_tensors(
    path: str | os.PathLike[str], framework: Literal["torch", "numpy"], names: Iterable[str] | None = None
) -> tuple[dict[str, str], dict[str, Any]]:
    """Header and tensors of a safetensors container, of all names or of these.

    Raises:
        OSError: The file cannot be opened.
        ValueError: The file is damaged, has no tensor of a name, or one of a type that the framework lacks.
        PlaceError: The path is not UTF-8, which the library would take for a damaged file.
    """
    from safetensors import SafetensorError, safe_open

    require_utf8(Path(path))
    try:
        with safe_open(os.fspath(path), framework) as file:
            return file.metadata() or {}, {
                name: file.get_tensor(name) for name in (file.keys() if names is None else names)
            }
    except (SafetensorError, TypeError, AttributeError) as error:  # NumPy lacks types that torch has
        raise ValueError(str(error)) from error
