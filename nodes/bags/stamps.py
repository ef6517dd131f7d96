"""Delays of the messages of a bag, from capture to publication to reception, by topic."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from nodes.bags.reader import read_info, read_messages
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import fields_of
from nodes.runtime.topics import type_of_topic

# In CDR, a message with a header begins with four bytes of encapsulation, followed by the stamp.
_STAMP = struct.Struct("<iI"), struct.Struct(">iI")
_STAMP_AT, _NS_PER_MS = 4, 1e6


@dataclass(frozen=True)
class Delays:
    """Delays of one topic [ms]; None if the messages have no stamp, or a stamp of zero.

    Attributes:
        publish_ms: Median from capture to publication.
        publish_worst_ms: Longest delay from capture to publication.
        receive_ms: Median from publication to reception by the recorder.
        receive_worst_ms: Longest delay from publication to reception.
        backwards: Number of messages whose stamp is older than the previous message's.
        future: Number of messages with a capture time after their reception, which means a wrong clock.
    """

    publish_ms: float | None
    publish_worst_ms: float | None
    receive_ms: float
    receive_worst_ms: float
    backwards: int
    future: int


def read_delays(bag: Path) -> dict[str, Delays]:
    """Read the delays of every topic with messages, by name. The whole bag is read."""
    names = {topic.name: _begins_with_stamp(topic.name, topic.type) for topic in read_info(bag).topics}
    rows: dict[str, list[tuple[int, int, int]]] = {}
    for message in read_messages(bag, as_recorded=True):
        stamp_ns = _stamp_ns(message.cdr) if names[message.topic] else 0
        rows.setdefault(message.topic, []).append((stamp_ns, message.publish_ns, message.log_ns))
    return {topic: _delays(found) for topic, found in rows.items()}


def _delays(times_ns: list[tuple[int, int, int]]) -> Delays:
    """Compute delays from stamp, publish and log time of each message [ns]. Integers, because a damaged bag may have any value."""
    received = [(log - publish) / _NS_PER_MS for _, publish, log in times_ns]
    stamped = [row for row in times_ns if row[0] > 0]
    published = [(publish - stamp) / _NS_PER_MS for stamp, publish, _ in stamped]
    return Delays(
        float(np.median(published)) if published else None,
        max(published, default=None),
        float(np.median(received)),
        max(received),
        sum(after[0] < before[0] for before, after in pairwise(stamped)),
        sum(stamp > log for stamp, _, log in stamped),
    )


def _begins_with_stamp(topic: str, typename: str) -> bool:
    """Whether a topic is in the topic table and its type begins with a header."""
    fields = fields_of(typename) or []
    return type_of_topic(topic) == typename and fields[0][0] == "header"


def _stamp_ns(cdr: bytes) -> int:
    if len(cdr) < _STAMP_AT + 8:
        return 0
    seconds, nanoseconds = _STAMP[0 if cdr[1] & 1 else 1].unpack_from(cdr, _STAMP_AT)
    return int(seconds) * NS_PER_S + int(nanoseconds)
