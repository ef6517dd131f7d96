"""Errors of a set of posed images."""

from __future__ import annotations

from collections.abc import Sequence

from advnerf_core.documents import one_a_line
from advnerf_core.errors import AdvnerfError


class DatasetError(AdvnerfError):
    """A set of posed images cannot be used; the message names the file, the frame and the field."""


def raise_all(errors: Sequence[DatasetError], count: int, what: str) -> None:
    """Raise the errors of some of ``count`` frames or images as one; return if there are none."""
    if not errors:
        return
    if len(errors) == 1:
        raise errors[0]
    lines = one_a_line([str(error) for error in errors])
    raise DatasetError(f"{len(errors)} of {count} {what} cannot be used:\n  {lines}")
