"""The log of who did what, one line of JSON for each act. It is written by another thread, after the act took effect."""

from __future__ import annotations

import json
import os
from collections import deque
from pathlib import Path
from typing import Any

from nodes.operator_page.disk import DiskWriter
from nodes.runtime.clock import Now

_SHOWN = 12


class Diary:
    """Appends acts to a file and remembers the last ones for the page.

    A disk that is full or does not answer delays the log. It neither delays nor undoes an act.

    Args:
        file: The log. An existing one is continued.
    """

    def __init__(self, file: Path, disk: DiskWriter) -> None:
        self._file, self._disk = file, disk
        self._descriptor: int | None = None
        self._unwritten = b""
        self._last: deque[dict[str, Any]] = deque(maxlen=_SHOWN)

    @property
    def last(self) -> list[dict[str, Any]]:
        """The last acts, newest first."""
        return list(reversed(self._last))

    def note(
        self, now: Now, operator: str, address: str, act: str, detail: str, frame_ns: int, answer: str
    ) -> None:
        """Note an act. It is written to the log soon.

        Args:
            frame_ns: Capture stamp of the newest picture that the operator saw [ns].
            answer: Why the act was refused; empty if it was granted.
        """
        row = {
            "real_ns": now.real_ns,
            "mono_ns": now.mono_ns,
            "operator": operator,
            "address": address,
            "act": act,
            "detail": detail,
            "frame_ns": frame_ns,
            "refused": answer,
        }
        line = (json.dumps(row, ensure_ascii=False) + "\n").encode()
        self._disk.submit(lambda: self._write(line))
        shown = {
            "real_ms": now.real_ns // 1_000_000,
            "operator": operator,
            "act": act,
            "detail": detail,
            "refused": answer,
        }
        self._last.append(shown)

    def close(self) -> None:
        """Close the file. Close the writer before it."""
        if self._descriptor is not None:
            os.close(self._descriptor)
        self._descriptor = None

    def _write(self, line: bytes) -> None:
        """Append a line. After a failure, the next call continues with the rest of the same line."""
        if self._descriptor is None:
            self._file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
            self._descriptor = os.open(self._file, flags, 0o600)
        self._unwritten = self._unwritten or line
        while self._unwritten:
            self._unwritten = self._unwritten[os.write(self._descriptor, self._unwritten) :]
