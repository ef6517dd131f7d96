"""Decides requests to arm and to disarm. Each is decided once, and a repeat never arms.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

from nodes.control.arming import Arming
from nodes.runtime.requests import Answer, AnswerMemory, is_id


class ArmRequests:
    """Decides requests and remembers the answers.

    Args:
        arming: The arming state machine.
    """

    def __init__(self, arming: Arming) -> None:
        self._arming = arming
        self._answers = AnswerMemory()
        self._asked_ns: dict[str, int] = {}
        self._forgotten_ns = 0

    @property
    def last(self) -> Answer:
        """The answer to the newest request."""
        return self._answers.last

    def arm(self, ask_id: str, source: str, asked_ns: int, mono_ns: int, refusal: str = "") -> None:
        """Decide a request to arm. A repeat gets the same answer.

        Args:
            ask_id: Id of the request.
            source: Source of the request.
            asked_ns: Time of the first repeat, on this host's monotonic clock [ns].
            mono_ns: Current time [ns].
            refusal: Why the request does not count; empty if it does.
        """
        if self._answers.repeat(ask_id):
            return
        if not is_id(ask_id):
            refusal = f"expected an ask_id of 1 to 64 characters, got {len(ask_id)}; use advnerf car arm"
        elif asked_ns <= self._forgotten_ns:
            refusal = "the request is older than one that was already decided and forgotten; arm again"
        elif not refusal:
            refusal = self._arming.arm(source, asked_ns, mono_ns)
        self._keep(Answer(ask_id, not refusal, refusal or "armed"), asked_ns)

    def disarm(self, ask_id: str, reason: str, asked_ns: int, mono_ns: int) -> None:
        """Disarm at every repeat, because a sender that still repeats the request has not received its answer."""
        if not self._answers.repeat(ask_id):
            self._keep(Answer(ask_id, True, "disarmed"), asked_ns)
        elif not self._arming.armed:
            return  # keep the reason of the first repeat
        self._arming.disarm(reason, mono_ns)

    def _keep(self, answer: Answer, asked_ns: int) -> None:
        if is_id(answer.ask_id):
            self._asked_ns[answer.ask_id] = asked_ns
        if (forgotten := self._answers.give(answer)) is not None:
            # A repeat of the forgotten request would not be recognised, so all requests of its age are void.
            self._forgotten_ns = max(self._forgotten_ns, self._asked_ns.pop(forgotten.ask_id))
