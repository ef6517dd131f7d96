"""Code that files name: found in their data, made absolute, and listed before it is executed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from advnerf_core.plugins import absolute_reference


def with_absolute_code(data: Any, folder: Path) -> Any:
    """The same data; ``kind: file.py:Class`` names its file by an absolute path, so that other processes find it.

    Args:
        data: Plain data of a file.
        folder: Folder that a relative ``file.py`` is relative to.
    """
    if isinstance(data, list):
        return [with_absolute_code(each, folder) for each in data]
    if not isinstance(data, dict):
        return data
    changed = {key: with_absolute_code(value, folder) for key, value in data.items()}
    if isinstance(kind := data.get("kind"), str):
        changed["kind"] = absolute_reference(kind, folder)
    return changed
