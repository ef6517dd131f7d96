"""Writes files so that readers, and crashes, never leave half of one, and the same content gives the same bytes."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from advnerf_core.places import require_utf8


def write_atomically(path: Path, data: str | bytes) -> None:
    """Write a whole file or nothing: under a temporary name first, synced, then renamed over ``path``."""
    require_utf8(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as stream:
            stream.write(data.encode() if isinstance(data, str) else data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, data: Any) -> None:
    """Write an indented JSON value, whole or not at all."""
    write_atomically(path, json.dumps(data, indent=1) + "\n")


def sha256_of(file: Path) -> str:
    """SHA-256 of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def with_sorted_header(content: bytes) -> bytes:
    """The same safetensors container with the keys of its header in order: the library's order changes from process to process."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # the tensors stay aligned
    return len(header).to_bytes(8, "little") + header + content[end:]
