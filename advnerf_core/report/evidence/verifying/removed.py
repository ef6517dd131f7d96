"""The log of published results that were removed or rewritten, each with the reason."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError, model_validator

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.registration import SetError
from advnerf_core.strict import StrictModel

LOG = "removed.json"


class Removed(StrictModel):
    """Results that were removed or rewritten for one reason.

    Attributes:
        kind: Kind of the entries: removed rows of the ledger, values of rows that replaced others of one measurement, registered
            scenarios (``SET/SCENARIO``), files (by path), sets, or registrations that were rewritten before anything of their sets
            was run (``SET``).
        names: Name of each entry.
        reason: Why.
        stands: For ``value``, the new value of each row; a later one is not covered.
        commit: The commit, if its number is known; for readers.
    """

    kind: Literal["row", "value", "scenario", "file", "set", "registration"]
    names: tuple[str, ...] = Field(min_length=1)
    reason: str = Field(min_length=10)
    stands: dict[str, float | str] = Field(default_factory=dict)
    commit: str = ""

    @model_validator(mode="after")
    def _stands_for_values(self) -> Removed:
        if self.stands.keys() != (set(self.names) if self.kind == "value" else set()):
            raise ValueError(
                "expected stands to hold the value of each row of kind value, and of nothing else"
            )
        return self

    def entries(self) -> Iterator[tuple[str, str]]:
        """Kind and name of each entry, as checks look them up; a value with its row (`value_entry`)."""
        if self.kind == "value":
            yield from (value_entry(line, value) for line, value in self.stands.items())
        else:
            yield from ((self.kind, name) for name in self.names)


def value_entry(line: str, value: float | str) -> tuple[str, str]:
    """Log key of a row's value that replaced another one of the same measurement."""
    return "value", f"{line}: {value}"


def read_removed(published: Path) -> dict[tuple[str, str], str]:
    """The reason of each logged removal, by kind and name; empty without a log.

    Raises:
        SetError: The file is not such a log.
    """
    file = published / LOG
    if not file.exists():
        return {}
    try:
        found = [Removed.model_validate(each) for each in read_json(file)]
    except (OSError, ValueError, TypeError, ValidationError) as error:
        text = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise SetError(
            f"{file}: expected a list of removals with their reasons, got: {text}; restore it from git"
        ) from None
    return {entry: each.reason for each in found for entry in each.entries()}
