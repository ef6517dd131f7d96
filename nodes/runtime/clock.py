"""The two clocks of a node. They are passed to the node, so that tests and replays can pass other ones.

Monotonic time is for durations, ages and deadlines on one host. Real time (CLOCK_REALTIME) is for capture stamps.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class Now:
    """One instant read from both clocks.

    Attributes:
        mono_ns: CLOCK_MONOTONIC [ns], the same for all processes of one host.
        real_ns: CLOCK_REALTIME [ns since 1970].
    """

    mono_ns: int
    real_ns: int

    @property
    def mono_s(self) -> float:
        """Monotonic time [s]."""
        return self.mono_ns / NS_PER_S

    @property
    def real_s(self) -> float:
        """Real time [s since 1970]."""
        return self.real_ns / NS_PER_S


class Clock(Protocol):
    """Interface of a clock."""

    def now(self) -> Now:
        """Read both clocks."""
        ...


class SystemClock:
    """The clocks of this computer."""

    def now(self) -> Now:
        """Read both clocks."""
        return Now(time.monotonic_ns(), time.time_ns())


class ManualClock:
    """A clock that moves only when `advance` is called, for tests and lockstep replay."""

    def __init__(self, mono_ns: int = 0, real_ns: int = 0) -> None:
        self._now = Now(mono_ns, real_ns)

    def now(self) -> Now:
        """Read both clocks."""
        return self._now

    def advance(self, duration_s: float) -> Now:
        """Move both clocks forward by a duration [s]."""
        step_ns = round(duration_s * NS_PER_S)
        if step_ns < 0:
            raise ValueError(f"expected a duration >= 0 s, got {duration_s}")
        self._now = Now(self._now.mono_ns + step_ns, self._now.real_ns + step_ns)
        return self._now
