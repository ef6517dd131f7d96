"""A file together with the files that it refers to, each read once, so that the hash matches the used content.

An ONNX file may store its weights in other files, a mesh its textures. Users do not control these names, so a name may lead out of the
folder, or through a link. Both are refused. Content is read into memory once, so that no file can change between its hash and its use.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from types import MappingProxyType

from advnerf_core.errors import AdvnerfError

_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # a named pipe must not block


class InputFileError(AdvnerfError, ValueError):
    """A file refers to another one that is missing, or is in a forbidden place."""


class InputFiles:
    """A file and the files that it refers to, with the content of their first reading.

    Args:
        path: The file itself. If it is a link, the other files lie beside the link's target.

    Raises:
        OSError: The file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = path.read_bytes()
        self._folder = path.resolve().parent
        self._others: dict[str, bytes] = {}

    def read(self, name: str) -> bytes:
        """Content of a file that this one refers to.

        Args:
            name: Name in the file, relative to the file's folder.

        Raises:
            InputFileError: The folder has no regular file of this name, or a link leads to it.
        """
        written = PurePosixPath(name.strip().replace("\\", "/"))
        if written.is_absolute() or ".." in written.parts or not written.parts or "\0" in name:
            raise InputFileError(
                f"expected {self.path} to refer to files in its own folder, got {name!r}; put that file beside it and name it so"
            )
        if (key := written.as_posix()) not in self._others:
            try:
                self._others[key] = _read_without_links(self._folder, written.parts)
            except OSError as error:
                raise InputFileError(
                    f"{self.path} refers to {name}, expected as a file in {self._folder} without links, got: {error.strerror}; "
                    "copy that file there"
                ) from error
        return self._others[key]

    @property
    def others(self) -> Mapping[str, bytes]:
        """Content by name of the other files that were read."""
        return MappingProxyType(self._others)

    def sha256(self, declared: str = "") -> str:
        """Hash of all content that was read; for a file without others, the hash of its bytes.

        Args:
            declared: Further text to hash, such as a declaration.
        """
        digest = hashlib.sha256(self.content + declared.encode())
        for name, content in sorted(self._others.items()):
            digest.update(f"\0{name}\0{hashlib.sha256(content).hexdigest()}".encode())
        return digest.hexdigest()


def _read_without_links(folder: Path, parts: tuple[str, ...]) -> bytes:
    """Content of a regular file. Each part of its path is opened relative to the one before, so that no link is followed."""
    at = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for last, part in zip((False,) * (len(parts) - 1) + (True,), parts, strict=True):
            inner = os.open(part, _FLAGS if last else _FLAGS | os.O_DIRECTORY, dir_fd=at)
            os.close(at)
            at = inner
        if not stat.S_ISREG(os.fstat(at).st_mode):
            raise OSError(0, "it is no regular file")
        with os.fdopen(os.dup(at), "rb") as stream:
            return stream.read()
    finally:
        os.close(at)
