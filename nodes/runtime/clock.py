"""The clocks of a node. They are passed to the node, so that tests and replays can pass other ones.

Monotonic time is for durations, ages and deadlines on one host. Real time (CLOCK_REALTIME) is for capture stamps. Monotonic time
stands still while the computer is suspended, and CLOCK_BOOTTIME does not: their difference shows a suspend.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

NS_PER_S = 1_000_000_000
# A process that was held up between two readings of a clock cannot tell their difference.
_LONGEST_READ_NS = 1_000_000


@dataclass(frozen=True)
class Now:
    """One instant read from all clocks.

    Attributes:
        mono_ns: CLOCK_MONOTONIC [ns], the same for all processes of one host.
        real_ns: CLOCK_REALTIME [ns since 1970].
        asleep_ns: CLOCK_BOOTTIME minus CLOCK_MONOTONIC: the total time for which the computer was suspended, plus a constant [ns].
            None if the clocks could not be read within a millisecond of each other, or if there is no such clock.
    """

    mono_ns: int
    real_ns: int
    asleep_ns: int | None = None

    @property
    def real_s(self) -> float:
        """Real time [s since 1970]."""
        return self.real_ns / NS_PER_S


class Clock(Protocol):
    """Interface of a clock."""

    def now(self) -> Now:
        """Read all clocks."""
        ...


def _boot_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class SystemClock:
    """The clocks of this computer. Each can be replaced, for tests.

    Args:
        mono: Reads CLOCK_MONOTONIC [ns].
        boot: Reads CLOCK_BOOTTIME [ns].
        real: Reads CLOCK_REALTIME [ns].
    """

    def __init__(
        self,
        mono: Callable[[], int] = time.monotonic_ns,
        boot: Callable[[], int] = _boot_ns,
        real: Callable[[], int] = time.time_ns,
    ) -> None:
        self._mono, self._boot, self._real = mono, boot, real

    def now(self) -> Now:
        """Read all clocks: the others between two readings of monotonic time, which must lie close together."""
        before_ns, boot_ns, real_ns, mono_ns = self._mono(), self._boot(), self._real(), self._mono()
        read_ns = mono_ns - before_ns
        asleep_ns = boot_ns - before_ns - read_ns // 2 if read_ns <= _LONGEST_READ_NS else None
        return Now(mono_ns, real_ns, asleep_ns)


class ManualClock:
    """A clock that moves only when `advance` is called, for tests and lockstep replay."""

    def __init__(self, mono_ns: int = 0, real_ns: int = 0) -> None:
        self._now = Now(mono_ns, real_ns)

    def now(self) -> Now:
        """Read all clocks."""
        return self._now

    def advance(self, duration_s: float) -> Now:
        """Move both clocks forward by a duration [s]."""
        step_ns = round(duration_s * NS_PER_S)
        if step_ns < 0:
            raise ValueError(f"expected a duration >= 0 s, got {duration_s}")
        self._now = Now(self._now.mono_ns + step_ns, self._now.real_ns + step_ns)
        return self._now
