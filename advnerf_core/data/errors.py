"""What can be wrong with a set of posed images."""

from __future__ import annotations

from advnerf_core.errors import AdvnerfError


class DatasetError(AdvnerfError):
    """A set of posed images cannot be used; the message names the file, the frame, the field and what is wrong with it."""
