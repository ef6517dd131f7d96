"""Drives that a busy machine spoils are driven again. What is stopped is judged by timing alone, before anything is measured."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_DRIVES, _REST_S = 8, 1.0
# What the safety node says of messages that are late, and of itself: it stops the car then, as it should.
_LATE = re.compile(
    r"\bno (fresh )?(command|camera image|pose|frame|message)\b.* for \d|silent for \d|held up for \d|image \d\S* s old"
)


class Spoiled(Exception):
    """The car was stopped before its fault.

    Args:
        reason: What the safety node says.
    """


def unspoiled(drive: Callable[[], T]) -> T:
    """Drive until nothing was late; what the drive returned.

    Args:
        drive: Drives once, and raises `Spoiled` if the car was stopped before its time. A stop for any other reason than late
            messages ends the test at once.
    """
    for attempt in range(_DRIVES):
        try:
            return drive()
        except Spoiled as spoiled:
            if not _LATE.search(str(spoiled)) or attempt + 1 == _DRIVES:
                raise
            print(f"\na drive was spoiled by load ({spoiled}); again", file=sys.__stderr__)
            time.sleep(_REST_S)
    raise AssertionError("unreachable")
