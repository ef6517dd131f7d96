"""Clean-up actions that run when a scene is closed, also after an error."""

from __future__ import annotations

from collections.abc import Callable


class Undo:
    """A list of clean-up actions, run last one first; a failing action does not stop the others."""

    def __init__(self) -> None:
        self._entries: list[tuple[str, Callable[[], object]]] = []

    def push(self, what: str, action: Callable[[], object]) -> None:
        """Add an action; ``what`` describes it in the message if it fails."""
        self._entries.append((what, action))

    def run(self) -> list[str]:
        """Run and forget all actions. Returns what failed, and how."""
        failed = []
        while self._entries:
            what, action = self._entries.pop()
            try:
                action()
            except Exception as error:  # of a foreign library or a server that is gone
                failed.append(f"{what}: {error}")
        return failed
