"""The one way for a test to wait: generous, and it says for what. How long something takes is for a benchmark, or a `timing` test."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import pytest

T = TypeVar("T")
_PERIOD_S = 0.005


def wait_for(condition: Callable[[], T], what: str, timeout_s: float = 60.0) -> T:
    """Wait until a condition holds; what it returned then.

    Args:
        condition: Is asked again and again, and holds when it returns something true.
        what: What is waited for, for the failure: "timed out after 60 s waiting for <what>".
        timeout_s: A guard against waiting for ever [s], not a bound on how long it may take.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        late = time.monotonic() >= deadline  # asked once more after a long pause of this process
        if found := condition():
            return found
        if late:
            pytest.fail(f"timed out after {timeout_s:g} s waiting for {what}")
        time.sleep(_PERIOD_S)
