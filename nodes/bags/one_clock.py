"""Whether the stamps of several topics of a bag are of one clock: what joins them by stamps would join other times else."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from nodes.bags.reader import read_messages
from nodes.bags.stamps import read_stamps
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError

# Delays from stamp to recording differ by less between topics of one clock, also over Wi-Fi.
_MOST_APART_S = 0.5
# No message is recorded before it is stamped: beyond these, the delay of a topic and its distance from another's are those of another clock.
_MOST_AHEAD_S, _ENOUGH_APART_S = 0.05, 0.1
# Delays are compared in stretches of this length, in each from at least this many messages: a clock may drift, or be set in the middle.
_STRETCH_S, _ENOUGH = 5.0, 3
# A stretch in which the recorder's clock was set proves nothing.
_STRETCHES = 2


class OneClockError(BagError):
    """Topics of a bag are stamped by different clocks."""


def require_one_clock(bag: Path, topics: Sequence[str]) -> None:
    """Refuse topics whose stamps are of different clocks; those without stamps, or with equal ones, are left out.

    Raises:
        OneClockError: The delays of two topics, from stamp to recording, differ by more than any link explains.
    """
    stretches = [each for each in _delays_s(bag, topics) if len(each) > 1]
    apart = [each for each in stretches if _apart_s(each) > _most_apart_s(each)]
    if len(apart) < min(_STRETCHES, len(stretches)) or not apart:
        return
    worst = max(apart, key=_apart_s)
    last, first = max(worst, key=worst.__getitem__), min(worst, key=worst.__getitem__)
    raise OneClockError(
        f"{bag}: expected stamps of one clock, got those of {first} {_beside(worst[first])} their recording, and those of {last} "
        f"{_beside(worst[last])} it; set the clocks of all computers (chrony) and record again"
    )


def _apart_s(delays_s: Mapping[str, float]) -> float:
    return max(delays_s.values()) - min(delays_s.values())


def _most_apart_s(delays_s: Mapping[str, float]) -> float:
    """How far delays of one clock may be apart [s]: less if one topic was recorded before its stamp."""
    return _ENOUGH_APART_S if min(delays_s.values()) < -_MOST_AHEAD_S else _MOST_APART_S


def _delays_s(bag: Path, topics: Sequence[str]) -> Iterator[Mapping[str, float]]:
    """Median delay of each stamped topic [s], in each stretch of the bag."""
    stamp_of = read_stamps(bag)
    times_ns: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for message in read_messages(bag, list(topics), as_recorded=True):
        times_ns[message.topic].append((message.log_ns, stamp_of(message)))
    stamped = {topic: rows for topic, rows in times_ns.items() if len({stamp for _, stamp in rows}) > 1}
    first_ns = min((rows[0][0] for rows in stamped.values()), default=0)
    stretches: dict[int, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for topic, rows in stamped.items():
        for log_ns, stamp_ns in rows:
            number = int((log_ns - first_ns) / NS_PER_S / _STRETCH_S)
            stretches[number][topic].append((log_ns - stamp_ns) / NS_PER_S)
    for _, found in sorted(stretches.items()):
        yield {topic: float(np.median(each)) for topic, each in found.items() if len(each) >= _ENOUGH}


def _beside(delay_s: float) -> str:
    return f"{abs(delay_s):.3g} s {'before' if delay_s >= 0.0 else 'after'}"
