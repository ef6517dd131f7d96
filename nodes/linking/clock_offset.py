"""Offset of another host's clock from four stamps, after NTP (RFC 5905, sections 8 and 10). Pure arithmetic."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from nodes.runtime.clock import NS_PER_S


@dataclass(frozen=True)
class Exchange:
    """One question and its answer, in real time [ns]: asked and heard by our clock, received and answered by theirs."""

    asked_ns: int
    received_ns: int
    answered_ns: int
    heard_ns: int

    @property
    def offset_s(self) -> float:
        """Their clock minus ours [s], as if both ways took equally long."""
        return ((self.received_ns - self.asked_ns) + (self.answered_ns - self.heard_ns)) / 2 / NS_PER_S

    @property
    def round_trip_s(self) -> float:
        """Time on the way [s]; twice the bound of the offset's error."""
        return ((self.heard_ns - self.asked_ns) - (self.answered_ns - self.received_ns)) / NS_PER_S


class OffsetFilter:
    """Keeps the exchange with the shortest round trip of a short window, which has the smallest error.

    Args:
        length: Exchanges in the window.
    """

    def __init__(self, length: int = 8) -> None:
        self._window: deque[Exchange] = deque(maxlen=length)

    def add(self, exchange: Exchange) -> Exchange:
        """Note an exchange; returns the best one now."""
        best = min(self._window, key=lambda e: e.round_trip_s, default=exchange)
        # Both offsets are known up to half their round trip. Intervals that do not meet mean that a clock was set.
        if abs(exchange.offset_s - best.offset_s) > (exchange.round_trip_s + best.round_trip_s) / 2:
            self._window.clear()
        self._window.append(exchange)
        return min(self._window, key=lambda e: e.round_trip_s)
