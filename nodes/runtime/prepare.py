"""First steps of every node's process: its share of the processors, its file descriptors, and a log that cannot end it."""

from __future__ import annotations

import sys
from typing import Any, cast

from nodes.runtime.descriptors import raise_limit
from nodes.runtime.priority import take_share_of


class SteadyStream:
    """A text stream whose errors are ignored: a full disk under the log must not end a node."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        try:
            return int(self._stream.write(text))
        except OSError:
            return len(text)

    def flush(self) -> None:
        """Flush the stream if the disk takes it."""
        try:
            self._stream.flush()
        except OSError:
            return


def prepare_process(role: str) -> None:
    """Prepare the process of a node. Called once, before anything else."""
    raise_limit()
    take_share_of(role)
    sys.stdout, sys.stderr = cast(Any, SteadyStream(sys.stdout)), cast(Any, SteadyStream(sys.stderr))
