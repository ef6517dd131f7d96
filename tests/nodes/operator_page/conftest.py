"""The browser of the tests of the page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture(scope="module")
def playwright() -> Iterator[Any]:
    """Playwright at work."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as running:
        yield running
