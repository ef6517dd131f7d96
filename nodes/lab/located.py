"""Files that a user's file names: relative to it, absolute once it is read; results depend on what they hold, not on where they lie."""

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


def located(path: Path, info: ValidationInfo) -> Path:
    """A file or folder, absolute.

    Raises:
        PydanticCustomError: It is not there.
    """
    found = ((info.context or {}).get("folder") or Path.cwd()) / expanded(path)
    if not found.exists():
        text = f"expected a file or folder relative to this file, got {path}, which is not there"
        raise PydanticCustomError(COMPLETE, "{text}", {"text": text})
    return found.resolve()


def is_read_again(info: SerializationInfo) -> bool:
    """Whether what is written is a file that is read again, and not what results depend on."""
    return isinstance(info.context, dict) and bool(info.context.get("read_again"))


def _written(path: Path, info: SerializationInfo) -> str:
    return str(path) if is_read_again(info) else content_sha256(path)


def content_sha256(path: Path) -> str:
    """Hash of a file; kept until it is written again."""
    return _digest(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, changed_ns: int) -> str:
    del changed_ns
    return sha256_of(path)


NamedFile = Annotated[Path, AfterValidator(located), PlainSerializer(_written)]
"""A file; as data that results depend on it is the hash of its content."""

NamedFolder = Annotated[Path, AfterValidator(located)]
