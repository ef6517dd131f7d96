"""Compares capture stamps with the receiver's clock. A recording has fresh publish times, but its capture stamps are old.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

from dataclasses import dataclass

from nodes.runtime.clock import NS_PER_S, Now

AHEAD_LIMIT_S = 0.05
"""Largest accepted lead of a stamp over the receiver's clock [s]: the largest error between the clocks of two hosts that may drive."""
COMMAND_AGE_S = 0.5
"""Largest age of the image or the pose that a command to move is based on, where the command leaves for a motor [s]."""
REQUEST_AGE_S = 2.0
"""Largest age of a request to a device, since it was first asked [s]."""


def stamp_age_s(stamp_ns: int, real_ns: int) -> float:
    """Age of a capture stamp on the receiver's clock [s]; negative for a stamp in the future."""
    return (real_ns - stamp_ns) / NS_PER_S


def stamp_problem(age_s: float, limit_s: float, ahead_s: float = AHEAD_LIMIT_S) -> str:
    """Return why a capture stamp is not one of a moment ago; empty if it is.

    Args:
        age_s: Age of the stamp on the receiver's clock [s].
        limit_s: Largest accepted age [s].
        ahead_s: Largest accepted lead over the receiver's clock [s].
    """
    if age_s > limit_s:
        return f"its stamp is {age_s:.2f} s old, the limit is {limit_s:g} s"
    if age_s < -ahead_s:
        return f"its stamp is {-age_s:.2f} s in the future; set the clocks (chrony)"
    return ""


def captured_mono_ns(stamp_ns: int, now: Now) -> int:
    """Convert a capture stamp to the receiver's monotonic clock [ns]. A stamp in the future gives a time in the future."""
    return now.mono_ns - (now.real_ns - stamp_ns)


@dataclass
class ClockWatch:
    """Notices that the computer was suspended, or that its real-time clock was set.

    Monotonic time stands still during a suspend, so that everything looks fresh afterwards. After a step of the real-time clock, the
    ages of capture stamps are wrong. Readings that did not lie close together are skipped.

    Attributes:
        limit_s: Smallest change of the difference between two clocks that counts [s].
    """

    limit_s: float = 0.05
    _asleep_ns: int | None = None
    _real_less_mono_ns: int = 0

    def problem(self, now: Now) -> str:
        """Return once, after a suspend or a step, why earlier checks are no longer valid; empty otherwise."""
        if now.asleep_ns is None:
            return ""
        real_less_mono_ns = now.real_ns - now.mono_ns
        slept_s = stepped_s = 0.0
        if self._asleep_ns is not None:
            slept_s = (now.asleep_ns - self._asleep_ns) / NS_PER_S
            stepped_s = (real_less_mono_ns - self._real_less_mono_ns) / NS_PER_S
        slept, stepped = abs(slept_s) > self.limit_s, abs(stepped_s) > self.limit_s
        if slept or self._asleep_ns is None:
            self._asleep_ns = now.asleep_ns
        # Not compared with the first reading, because real time is slewed by up to half a millisecond a second.
        self._real_less_mono_ns = real_less_mono_ns
        if slept:
            return f"the computer was suspended for {slept_s:.2f} s"
        return f"the real-time clock was set by {stepped_s:+.2f} s" if stepped else ""
