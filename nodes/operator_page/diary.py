"""The log of who did what, one line of JSON for each act."""

from __future__ import annotations

import json
import os
from collections import deque
from pathlib import Path
from typing import Any

from nodes.runtime.clock import Now

_SHOWN = 12


class Diary:
    """Appends acts to a file and remembers the last ones for the page.

    Args:
        file: The log. An existing one is continued.
    """

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        self._stream = os.fdopen(descriptor, "a", encoding="utf-8")
        self._last: deque[dict[str, Any]] = deque(maxlen=_SHOWN)

    @property
    def last(self) -> list[dict[str, Any]]:
        """The last acts, newest first."""
        return list(reversed(self._last))

    def note(
        self, now: Now, operator: str, address: str, act: str, detail: str, frame_ns: int, answer: str
    ) -> None:
        """Write an act to the log.

        Args:
            now: Current time.
            operator: Name of the operator.
            address: Address of the browser.
            act: The act.
            detail: What it was about.
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
        self._stream.write(json.dumps(row, ensure_ascii=False) + "\n")
        self._stream.flush()
        shown = {
            "real_ms": now.real_ns // 1_000_000,
            "operator": operator,
            "act": act,
            "detail": detail,
            "refused": answer,
        }
        self._last.append(shown)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
