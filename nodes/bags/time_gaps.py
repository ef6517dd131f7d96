"""Jumps of a bag's log time: a recorder whose clock was set while it ran. The one rule for everything that walks through a bag."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from pathlib import Path

from nodes.bags.reader import has_publish_times, message_spans, read_messages, read_times_as_written
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError

# A running stack sends statuses every second. No recording is silent for an hour.
LONGEST_SILENCE_S = 3600.0
# A recorder writes the messages of a topic as it receives them, a second or so in a chunk: such chunks need not be read.
_MOST_BACK_S = 2.0
_OVERTAKEN_S = 0.1  # a message may be written after a later one
SET_BACK = "the recorder's clock was set back, and messages are read in the order of log time, not of the drive; record the drive again"
_UNITS = (("year", 365.25 * 86400.0), ("day", 86400.0), ("hour", 3600.0))


@dataclass(frozen=True)
class TimeGap:
    """A jump of the log time.

    Attributes:
        before_ns: Log time of the last message before it [ns since 1970].
        after_ns: Log time of the first message after it [ns since 1970].
        messages: Number of messages before it, in order of their log time.
    """

    before_ns: int
    after_ns: int
    messages: int

    def __str__(self) -> str:
        span_s = (self.after_ns - self.before_ns) / NS_PER_S
        unit, length_s = next(each for each in _UNITS if span_s >= each[1] or each is _UNITS[-1])
        count = round(span_s / length_s)
        return f"log time jumps by {count} {unit}{'s' * (count > 1)} after message {self.messages}"


def find_gaps(times_ns: Sequence[int]) -> tuple[TimeGap, ...]:
    """Find the gaps in log times that are in order [ns since 1970]."""
    return tuple(
        TimeGap(before, after, count)
        for count, (before, after) in enumerate(pairwise(times_ns), start=1)
        if after - before > LONGEST_SILENCE_S * NS_PER_S
    )


def read_gaps(bag: Path) -> tuple[TimeGap, ...]:
    """Find the gaps of a bag. Its messages are read only if its index leaves room for a gap."""
    limit_ns = LONGEST_SILENCE_S * NS_PER_S
    end_ns: int | None = None
    for first_ns, last_ns in sorted(message_spans(bag)):
        if last_ns - first_ns > limit_ns or (end_ns is not None and first_ns - end_ns > limit_ns):
            return find_gaps([message.log_ns for message in read_messages(bag, as_recorded=True)])
        end_ns = last_ns if end_ns is None else max(end_ns, last_ns)
    return ()


def read_steps_back(bag: Path) -> tuple[str, ...]:
    """Say where the log time of a topic goes back as it was written: the recorder's clock was set back. Read only if the index leaves room for it."""
    limit_ns = _MOST_BACK_S * NS_PER_S
    spans = message_spans(bag)
    ends_ns = accumulate((last_ns for _, last_ns in spans), max)
    if all(end_ns - first_ns <= limit_ns for (first_ns, _), end_ns in zip(spans, ends_ns, strict=True)):
        return ()
    found: list[str] = []
    latest_ns: dict[str, int] = {}
    for count, (topic, log_ns) in enumerate(read_times_as_written(bag)):
        back_ns = latest_ns.get(topic, log_ns) - log_ns
        if back_ns > limit_ns:
            found.append(
                f"log time goes back by {back_ns / NS_PER_S:.0f} s after message {count} as recorded"
            )
            latest_ns.clear()
        latest_ns[topic] = max(log_ns, latest_ns.get(topic, log_ns))
    return tuple(found)


def require_order(bag: Path, topic: str, numbers: Sequence[int]) -> None:
    """Refuse a topic whose messages lie in another order than they were published in: the recorder's clock was set back while it ran.

    Numbers also go back where the publisher was restarted, which is only said: its messages are in order. Bags of other recorders have no
    numbers, or zeros: their log times alone tell it.

    Args:
        numbers: The messages' numbers from their publisher, in the order of the bag.

    Raises:
        BagError: Their numbers go back more than once, and log times go back as they were written; or these go back, and there are no numbers.
    """
    numbered = has_publish_times(bag) and any(numbers)
    back = sum(after < before for before, after in pairwise(numbers))
    if numbered and back < 2:
        return
    written_ns = [log_ns for name, log_ns in read_times_as_written(bag) if name == topic]
    steps_ns = [before - after for before, after in pairwise(written_ns)]
    if not numbered:
        if (step_s := max(steps_ns, default=0) / NS_PER_S) > _OVERTAKEN_S:
            raise BagError(
                f"expected the messages of {topic} in {bag} in the order of the drive, got log times that go back by {step_s:.2g} s as they were "
                f"written; {SET_BACK}"
            )
        return
    if any(step > 0 for step in steps_ns):
        raise BagError(
            f"expected the messages of {topic} in {bag} in the order of their publication, got {back} that go back: the recorder's clock was set back "
            "while it ran, so that two stretches of time are mixed; record the drive again"
        )
    _say(bag, (f"the publisher of {topic} was restarted {back} times while the bag was recorded",))


def skipped_gaps(bag: Path) -> tuple[TimeGap, ...]:
    """Find the gaps of a bag for a reader that skips them, and name them once on standard error."""
    gaps = read_gaps(bag)
    _say(
        bag,
        (
            *(f"{gap}; this time is skipped" for gap in gaps),
            *(f"{step}; {SET_BACK}" for step in read_steps_back(bag)),
        ),
    )
    return gaps


@lru_cache(maxsize=64)
def _say(bag: Path, lines: tuple[str, ...]) -> None:
    for line in lines:
        print(f"{bag}: {line}", file=sys.stderr, flush=True)


def silence_s(gaps: Sequence[TimeGap]) -> float:
    """Sum of the gaps [s]."""
    return sum(gap.after_ns - gap.before_ns for gap in gaps) / NS_PER_S
