"""Receives new attacks over the bus, for the nodes that show them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from advnerf_core.attack.artifact import AttackFile, attack_from_bytes
from advnerf_core.errors import AdvnerfError
from nodes.runtime.transfer import Assembler
from nodes.runtime.wire import MessageInfo

ATTACK_FILE = "/attack/file"
T = TypeVar("T")


class AttackReceiver(Generic[T]):
    """Assembles attacks that come in pieces, and accepts those that fit.

    Args:
        prepare: Prepares an attack, or raises an error for one that does not fit.

    Attributes:
        taken: Number of accepted attacks.
        refused: Number of refused attacks and broken transfers.
        trouble: Why the last one was refused; empty if it was accepted.
    """

    def __init__(self, prepare: Callable[[AttackFile], T]) -> None:
        self._prepare = prepare
        self._assembler = Assembler()
        self._sha256 = ""
        self.taken = self.refused = 0
        self.trouble = ""

    def heard(self, chunk: Any, info: MessageInfo) -> T | None:
        """Handle a piece. Returns what was prepared after the last piece of an accepted attack, else None."""
        if chunk.sha256 == self._sha256 and not self._assembler.receiving:
            return None  # sent again for others
        received, trouble = self._assembler.add(chunk, info.instance_id)
        if trouble:
            self._refuse(trouble)
        if received is None:
            return None
        try:
            prepared = self._prepare(attack_from_bytes(received.content, f"the attack {received.name}"))
        except (AdvnerfError, ValueError) as error:
            self._refuse(str(error))
            return None
        self._sha256, self.trouble = received.sha256, ""
        self.taken += 1
        return prepared

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.trouble = f"new attack refused: {why}"
