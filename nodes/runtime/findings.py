"""Report of a check of a plug-in, a server or a policy: one finding for each part of what is asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from advnerf_core.plugins import FAILURES, in_one_line, is_signal

T = TypeVar("T")


class NotMet(Exception):
    """A part of the contract is not met; the text says what was expected, what was found, and what to change."""


class MetButLook(Exception):
    """A part of the contract is met, but with a number that a right plug-in does not have; the text says what was found, and what to look at."""


@dataclass(frozen=True)
class CheckFinding:
    """One line of the report.

    Attributes:
        name: What was checked, such as a part of a contract.
        state: ``met``, ``met, but look`` or ``not met``; ``ok``, ``warning`` or ``failure`` where there is no contract.
        text: The finding, with numbers; if it is not met also what to change.
    """

    name: str
    state: str
    text: str

    @property
    def met(self) -> bool:
        """Whether nothing needs to be changed."""
        return self.state not in ("not met", "failure")


def look(
    name: str, check: Callable[[T], str], bench: T, lets_through: tuple[type[Exception], ...] = ()
) -> CheckFinding:
    """The finding of one check.

    Args:
        check: Returns what was found, or raises `NotMet` or `MetButLook`.
        lets_through: Errors that end the whole report. Any other error is a part that is not met.
    """
    try:
        return CheckFinding(name, "met", check(bench))
    except NotMet as reason:
        return CheckFinding(name, "not met", str(reason))
    except MetButLook as reason:
        return CheckFinding(name, "met, but look", str(reason))
    except lets_through:
        raise
    except FAILURES as error:  # a plug-in may raise anything
        if isinstance(error, SystemExit) and is_signal(error.code):
            raise
        return CheckFinding(name, "not met", f"raised {in_one_line(error, 200)}")


def look_at_all(checks: Mapping[str, Callable[[T], str]], bench: T) -> list[CheckFinding]:
    """The finding of each check by its name; the first one alone if it is not met. See `look`."""
    findings: list[CheckFinding] = []
    for name, check in checks.items():
        findings.append(look(name, check, bench))
        if not findings[0].met:
            break
    return findings


def form_of(array: Any) -> str:
    """Type and shape of an array, or the type of anything else."""
    return f"{array.dtype} {list(array.shape)}" if isinstance(array, np.ndarray) else type(array).__name__
