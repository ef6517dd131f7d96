"""Report of checking a plug-in against its contract: one finding for each part of the contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


class NotMet(Exception):
    """A part of the contract is not met; the text says what was expected, what was found, and what to change."""


@dataclass(frozen=True)
class ContractFinding:
    """One line of the report.

    Attributes:
        name: Part of the contract.
        met: Whether it is met.
        text: The finding, with numbers; if it is not met also what to change.
    """

    name: str
    met: bool
    text: str


def look(
    name: str, check: Callable[[T], str], bench: T, lets_through: tuple[type[Exception], ...] = ()
) -> ContractFinding:
    """The finding of one check.

    Args:
        name: Part of the contract.
        check: Returns what was found, or raises `NotMet`.
        lets_through: Errors that end the whole report. Any other error is a part that is not met.
    """
    try:
        return ContractFinding(name, True, check(bench))
    except NotMet as reason:
        return ContractFinding(name, False, str(reason))
    except lets_through:
        raise
    except Exception as error:  # a plug-in may raise anything
        return ContractFinding(
            name, False, f"raised {type(error).__name__}: {' '.join(str(error).split()):.200}"
        )
