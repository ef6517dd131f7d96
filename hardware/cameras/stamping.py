"""Converts the stamps of devices to real and monotonic time, and detects unreliable stamps."""

from __future__ import annotations

import time
from collections.abc import Callable

NS_PER_S = 1_000_000_000
# A frame waits in the kernel for one frame period at most before the read thread takes it; 1 fps is the slowest we support.
_OLDEST_NS = 1_000_000_000
# Rounding to microseconds, and drivers that convert from the device's own clock, may put a stamp slightly ahead.
_AHEAD_NS = 5_000_000
_PATIENCE = 10


class Stamper:
    """Converts the stamps of one device. The results never go back.

    A stamp is accepted if it lies within the last second on the monotonic clock (as V4L2 and depthai's host clock specify) or on the
    real-time clock (as ``uvcvideo`` with ``clock=CLOCK_REALTIME`` delivers). If a device has never had such a stamp, its frames are
    stamped on reception. If it has, a frame with another stamp is considered old and is not delivered. After ten of them in a row its
    clock has jumped, and frames are stamped on reception until the stamps are valid again.

    Attributes:
        replaced: Number of frames stamped on reception.
        refused: Number of frames that were not delivered because of their stamp.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        realtime_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns = monotonic_ns
        self._realtime_ns = realtime_ns
        self._last_ns: int | None = None
        self._believed = False
        self._in_a_row = 0
        self.replaced = self.refused = 0

    def restart(self) -> None:
        """Reset after the device was reopened. Results still never go back."""
        self._believed, self._in_a_row = False, 0

    def convert(self, stamp_ns: int | None) -> tuple[int, int] | None:
        """Real time and monotonic time [ns] of a frame with this stamp, or None if it must not be delivered.

        Args:
            stamp_ns: Stamp of the device [ns]; None without a stamp.
        """
        real_ns, mono_ns = self._now()
        captured_ns = None if stamp_ns is None else _captured(stamp_ns, real_ns, mono_ns)
        if captured_ns is not None and (self._last_ns is None or captured_ns > self._last_ns):
            self._believed, self._in_a_row = True, 0
        elif self._believed and self._in_a_row < _PATIENCE:
            self._in_a_row += 1
            self.refused += 1
            return None
        else:
            captured_ns = mono_ns if self._last_ns is None else max(mono_ns, self._last_ns + 1)
            self.replaced += 1
        self._last_ns = captured_ns
        return captured_ns + (real_ns - mono_ns), captured_ns

    def _now(self) -> tuple[int, int]:
        # Read the monotonic clock before and after the real-time clock, because an interruption between would shift the stamp.
        before_ns = self._monotonic_ns()
        real_ns = self._realtime_ns()
        return real_ns, (before_ns + self._monotonic_ns()) // 2


def _captured(stamp_ns: int, real_ns: int, mono_ns: int) -> int | None:
    """Monotonic time of a stamp of either clock [ns], at most now; None if it is of neither."""
    for now_ns in (mono_ns, real_ns):
        if -_AHEAD_NS <= now_ns - stamp_ns <= _OLDEST_NS:
            return min(stamp_ns + (mono_ns - now_ns), mono_ns)
    return None


class Decimator:
    """Selects frames for a lower rate by their stamps: one for each slot of a regular grid.

    Args:
        rate_hz: Rate of frames to keep [Hz].
        source_hz: Rate of frames of the device [Hz].
    """

    def __init__(self, rate_hz: float, source_hz: float) -> None:
        if not 0.0 < rate_hz <= source_hz:
            raise ValueError(
                f"expected a rate > 0 Hz and at most that of the device, {source_hz:g} Hz; got {rate_hz:g} Hz"
            )
        self._period_ns = NS_PER_S / rate_hz
        self._half_source_ns = NS_PER_S / source_hz / 2.0
        self._start_ns: int | None = None
        self._slot = -1

    def restart(self) -> None:
        """Start a new grid at the next frame."""
        self._start_ns, self._slot = None, -1

    def slot(self, stamp_ns: int) -> int | None:
        """Number of the slot that this frame fills, or None if the frame is not selected. A skipped number means a missing frame."""
        if self._start_ns is None:
            self._start_ns = stamp_ns
        # Select the frame closest to the start of its slot, which may be up to half a frame early.
        slot = int((stamp_ns - self._start_ns + self._half_source_ns) // self._period_ns)
        if slot <= self._slot:
            return None
        self._slot = slot
        return slot
