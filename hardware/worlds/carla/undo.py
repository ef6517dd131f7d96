"""What has to be put back when a scene is closed, whatever happened in between."""

from __future__ import annotations

from collections.abc import Callable


class Undo:
    """A list of things to put back, last one first; one that fails does not keep the others from being done."""

    def __init__(self) -> None:
        self._entries: list[tuple[str, Callable[[], object]]] = []

    def push(self, what: str, action: Callable[[], object]) -> None:
        """Remember an action; ``what`` it does is for the message if it fails."""
        self._entries.append((what, action))

    def run(self) -> list[str]:
        """Do everything, and forget it. Returns what failed, and how."""
        failed = []
        while self._entries:
            what, action = self._entries.pop()
            try:
                action()
            except Exception as error:  # of a foreign library or a server that is gone
                failed.append(f"{what}: {error}")
        return failed
