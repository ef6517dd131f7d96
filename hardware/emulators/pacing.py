"""Keeps a thread on an absolute schedule: no drift, and no burst after a stall."""

from __future__ import annotations

import threading
import time

NS_PER_S = 1_000_000_000


class Pacer:
    """Ticks at ``start + k * period``; ticks missed while the thread was delayed are skipped and counted.

    Args:
        rate_hz: Ticks per second.
    """

    def __init__(self, rate_hz: float) -> None:
        self.period_ns = round(NS_PER_S / rate_hz)
        self.missed = 0
        self._next_ns = time.monotonic_ns()

    def wait(self, stop: threading.Event) -> int | None:
        """Sleep until the next tick; its scheduled monotonic time [ns], or None when ``stop`` is set."""
        now_ns = time.monotonic_ns()
        if now_ns > self._next_ns + self.period_ns:
            skipped = (now_ns - self._next_ns) // self.period_ns
            self.missed += skipped
            self._next_ns += skipped * self.period_ns
        elif now_ns < self._next_ns and stop.wait((self._next_ns - now_ns) / NS_PER_S):
            return None
        if stop.is_set():
            return None
        tick_ns = self._next_ns
        self._next_ns += self.period_ns
        return tick_ns
