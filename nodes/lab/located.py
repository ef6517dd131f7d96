"""Files that a user's file names: relative to it, absolute after reading; results depend on their content, not on their location."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, PlainSerializer, SerializationInfo, ValidationInfo
from pydantic_core import PydanticCustomError

from advnerf_core.files import sha256_of
from advnerf_core.places import expanded
from advnerf_core.strict import COMPLETE

# Context of `BaseModel.model_dump` for a file that is read again: files are written as absolute paths.
READ_AGAIN = {"read_again": True}


def beside(path: Path | str, info: ValidationInfo) -> Path:
    """A path relative to the file that names it, or to the current folder without a file."""
    folder: Path = (info.context or {}).get("folder") or Path.cwd()
    return folder / expanded(path)


def refusal(text: str) -> PydanticCustomError:
    """The error of a value, of which the text says everything."""
    return PydanticCustomError(COMPLETE, "{text}", {"text": text})


def located(path: Path, info: ValidationInfo) -> Path:
    """Absolute path of a file or folder.

    Raises:
        PydanticCustomError: The file or folder does not exist.
    """
    found = beside(path, info)
    if not found.exists():
        raise refusal(f"expected a file or folder relative to this file, got {path}, which is not there")
    return found.resolve()


def located_folder(path: Path, info: ValidationInfo) -> Path:
    """Absolute path of a folder.

    Raises:
        PydanticCustomError: It does not exist, or is a file.
    """
    found = located(path, info)
    if not found.is_dir():
        raise refusal(f"expected a folder relative to this file, got {path}, which is a file")
    return found


def is_read_again(info: SerializationInfo) -> bool:
    """Whether the output is a file that is read again; otherwise it is what results depend on."""
    return isinstance(info.context, dict) and bool(info.context.get("read_again"))


def _written(path: Path, info: SerializationInfo) -> str:
    return str(path) if is_read_again(info) else content_sha256(path)


def content_sha256(path: Path) -> str:
    """Hash of a file; cached until the file changes."""
    return _digest(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, changed_ns: int) -> str:
    del changed_ns
    return sha256_of(path)


NamedFile = Annotated[Path, AfterValidator(located), PlainSerializer(_written)]
"""A file; as data that results depend on it is the hash of its content."""

NamedFolder = Annotated[Path, AfterValidator(located_folder)]


def _contents_written(folder: Path, info: SerializationInfo) -> str | dict[str, str]:
    files = sorted(file for file in folder.iterdir() if file.is_file())
    return str(folder) if is_read_again(info) else {file.name: content_sha256(file) for file in files}


NamedContents = Annotated[NamedFolder, PlainSerializer(_contents_written)]
"""A folder; as data that results depend on it is its files' names and the hashes of their contents."""
