"""Playback of bags without the bus: the position in the recording, and the commands of the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nodes.bags.time_gaps import TimeGap
from nodes.runtime.errors import MessageError

PAUSE, RESUME, TOGGLE, STEP, RATE, STOP = "pause", "resume", "toggle", "step", "rate", "stop"
_PLAIN = (PAUSE, RESUME, TOGGLE, STOP)
_MOST_STEPS = 10_000
_SLOWEST, _FASTEST = 1e-3, 1e3


@dataclass(frozen=True)
class PlayerCommand:
    """A command to the player.

    Attributes:
        word: ``pause``, ``resume``, ``toggle``, ``step``, ``rate`` or ``stop``.
        number: Number of messages of a step, or speed of a rate relative to the recording.
    """

    word: str
    number: float = 1.0

    @classmethod
    def parse(cls, text: str) -> PlayerCommand:
        """Parse a command such as ``pause``, ``step``, ``step 10`` or ``rate 0.5``."""
        words = text.split()
        if len(words) == 1 and words[0] in (*_PLAIN, STEP):
            return cls(words[0])
        try:
            number = float(words[1]) if len(words) == 2 else -1.0
        except ValueError:
            number = -1.0
        if words[:1] == [RATE] and _SLOWEST <= number <= _FASTEST:
            return cls(RATE, number)
        if words[:1] == [STEP] and 1 <= number <= _MOST_STEPS and number == int(number):
            return cls(STEP, number)
        raise MessageError(
            f"expected pause, resume, toggle, step [N], rate X (0.001 to 1000) or stop, got {text[:80]!r}"
        )


class Playhead:
    """Position of the player in the recording.

    Args:
        bag_ns: Start time in the recording [ns since 1970].
        mono_ns: Current monotonic time [ns].
        rate: Speed relative to the recording.
        paused: Whether to start paused.
    """

    def __init__(self, bag_ns: int, mono_ns: int, rate: float = 1.0, paused: bool = False) -> None:
        self._bag_ns, self._mono_ns = bag_ns, mono_ns
        self.rate, self.paused = rate, paused

    def time_ns(self, mono_ns: int) -> int:
        """Time in the recording [ns since 1970]."""
        return self._bag_ns if self.paused else self._bag_ns + round((mono_ns - self._mono_ns) * self.rate)

    def jump(self, bag_ns: int, mono_ns: int) -> None:
        """Move to a time in the recording [ns since 1970]."""
        self._bag_ns, self._mono_ns = bag_ns, mono_ns

    def skip(self, gaps: Sequence[TimeGap], mono_ns: int) -> None:
        """Leave a gap of the recording at once."""
        time_ns = self.time_ns(mono_ns)
        for gap in gaps:
            if not self.paused and gap.before_ns < time_ns < gap.after_ns:
                self.jump(gap.after_ns, mono_ns)

    def pause(self, paused: bool, mono_ns: int) -> None:
        """Pause or resume."""
        self.jump(self.time_ns(mono_ns), mono_ns)
        self.paused = paused

    def set_rate(self, rate: float, mono_ns: int) -> None:
        """Change the speed."""
        self.jump(self.time_ns(mono_ns), mono_ns)
        self.rate = rate
