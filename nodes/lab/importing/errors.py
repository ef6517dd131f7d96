"""What can be wrong with recordings."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class ImportRecordingError(AdvnerfError):
    """A recording cannot become a data set; the message says what was expected, what came and what to do."""
