"""Errors of a set of posed images."""

from __future__ import annotations

from collections.abc import Sequence

from advnerf_core.errors import AdvnerfError

_MOST_LINES = 20


class DatasetError(AdvnerfError):
    """A set of posed images cannot be used; the message names the file, the frame and the field."""


def raise_all(errors: Sequence[DatasetError], count: int, what: str) -> None:
    """Raise the errors of some of ``count`` frames or images as one; return if there are none."""
    if not errors:
        return
    if len(errors) == 1:
        raise errors[0]
    lines = [str(error) for error in errors[:_MOST_LINES]]
    if len(errors) > len(lines):
        lines.append(f"and {len(errors) - len(lines)} more")
    raise DatasetError("\n  ".join([f"{len(errors)} of {count} {what} cannot be used:", *lines]))
