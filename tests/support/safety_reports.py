"""Reports of the safety node, as tests of its readers need them."""

from __future__ import annotations

from typing import Any

from nodes.runtime.messages import header, types
from tests.support.messages import filled


def state_message(stamp_ns: int, armed: bool, reason: str = "") -> Any:
    """A ``SafetyState`` that answers no request."""
    return filled(types.SafetyState, header=header(stamp_ns), armed=armed, stopping=not armed, reason=reason)
