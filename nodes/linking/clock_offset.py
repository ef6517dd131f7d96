"""Computes the offset of another host's clock from four stamps, as in NTP (RFC 5905, sections 8 and 10). Pure arithmetic."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from nodes.runtime.clock import NS_PER_S


@dataclass(frozen=True)
class Exchange:
    """The four real-time stamps [ns] of a question and its answer: sent and returned on the local clock, received and answered on the remote clock."""

    asked_ns: int
    received_ns: int
    answered_ns: int
    heard_ns: int

    @property
    def offset_s(self) -> float:
        """Remote clock minus local clock [s], assuming that both directions take equally long."""
        return ((self.received_ns - self.asked_ns) + (self.answered_ns - self.heard_ns)) / 2 / NS_PER_S

    @property
    def round_trip_s(self) -> float:
        """Round-trip time [s], which is twice the error bound of the offset."""
        return ((self.heard_ns - self.asked_ns) - (self.answered_ns - self.received_ns)) / NS_PER_S


class OffsetFilter:
    """Selects the exchange with the shortest round trip of a short window, because it has the smallest error."""

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=8)

    def add(self, exchange: Exchange) -> Exchange:
        """Add an exchange. Returns the best one."""
        best = min(self._window, key=lambda e: e.round_trip_s, default=exchange)
        # Each offset is known to within half its round trip. If two intervals do not overlap, a clock was set.
        if abs(exchange.offset_s - best.offset_s) > (exchange.round_trip_s + best.round_trip_s) / 2:
            self._window.clear()
        self._window.append(exchange)
        return min(self._window, key=lambda e: e.round_trip_s)
