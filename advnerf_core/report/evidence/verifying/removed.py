"""The log of what was removed from the published results, or written again: each with the reason."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.verifying.layout import SetError
from advnerf_core.strict import StrictModel

LOG = "removed.json"


class Removed(StrictModel):
    """Things that were removed or written again for one reason.

    Attributes:
        kind: What they are: rows of the ledger, registered scenarios (``SET/SCENARIO``), files (by path), sets, or registrations that
            were written again before anything of their sets was run (``SET``).
        names: Of each.
        reason: Why.
        commit: Which one, as far as its number goes; for readers.
    """

    kind: Literal["row", "scenario", "file", "set", "registration"]
    names: tuple[str, ...] = Field(min_length=1)
    reason: str = Field(min_length=10)
    commit: str = ""


def read_removed(published: Path) -> dict[tuple[str, str], str]:
    """The reason of each logged removal, by kind and name; empty without a log.

    Raises:
        SetError: The file is no such log.
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
    return {(each.kind, name): each.reason for each in found for name in each.names}
