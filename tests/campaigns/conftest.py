"""What all campaigns share: their size, and whether they write rows."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.campaigns.campaign import Campaign


@pytest.fixture
def campaign(request: pytest.FixtureRequest, tmp_path: Path) -> Campaign:
    """The campaign of a test's file."""
    size = os.environ.get("ADVNERF_CAMPAIGN_SIZE", "")
    return Campaign(request.path.stem.removeprefix("test_"), size, tmp_path)
