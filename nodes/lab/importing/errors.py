"""Errors of recordings."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class ImportRecordingError(AdvnerfError):
    """A recording cannot be converted to a data set. The message says what was expected, what came and what to do."""
