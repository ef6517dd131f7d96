"""Delays of the messages of a bag, from capture to publication to reception, by topic."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from nodes.bags.info import BagMessage
from nodes.bags.message_definitions import Definition, parse_definition
from nodes.bags.reader import has_publish_times, read_messages, recorded_topics
from nodes.bags.stored_types import ROS1, RecordedTopic
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError

# Of a message that begins with a header, four bytes precede the stamp: the encapsulation of CDR, or the sequence number of ROS 1.
_STAMP = struct.Struct("<iI"), struct.Struct(">iI")
_STAMP_AT, _NS_PER_MS = 4, 1e6
_Times = tuple[int, int, int, int]  # stamp, publish and log time, and number of a message


@dataclass(frozen=True)
class Delays:
    """Delays of one topic [ms]. Those of stamps are None if the messages have none, or zeros; those of publication if the bag has none.

    Attributes:
        publish_ms: Median from capture to publication; to reception if the bag has no publish times.
        publish_worst_ms: Longest such delay.
        receive_ms: Median from publication to reception by the recorder.
        receive_worst_ms: Longest delay from publication to reception.
        backwards: Number of messages whose stamp is older than the previous message's, or that were published before it: the clock of their
            sender, or the recorder's, was set back.
        future: Number of messages with a capture time after their reception, which means a wrong clock.
    """

    publish_ms: float | None
    publish_worst_ms: float | None
    receive_ms: float | None
    receive_worst_ms: float | None
    backwards: int | None
    future: int | None


def read_delays(bag: Path) -> dict[str, Delays]:
    """Read the delays of every topic with messages, by name. The whole bag is read."""
    stamp_of = read_stamps(bag)
    rows: dict[str, list[_Times]] = {}
    for message in read_messages(bag, as_recorded=True):
        stamp_ns = stamp_of(message)
        rows.setdefault(message.topic, []).append(
            (stamp_ns, message.publish_ns, message.log_ns, message.sequence)
        )
    published = has_publish_times(bag)
    return {topic: _delays(found, published) for topic, found in rows.items()}


def read_stamps(bag: Path) -> Callable[[BagMessage], int]:
    """A function that reads the stamp of a message as recorded [ns], without decoding it; 0 if it has none."""
    stored = {name: topic for name, topic in recorded_topics(bag).items() if _begins_with_stamp(topic)}

    def stamp_ns(message: BagMessage) -> int:
        recorded = stored.get(message.topic)
        return 0 if recorded is None else _stamp_ns(message.cdr, recorded.serialization)

    return stamp_ns


def _delays(times_ns: list[_Times], published: bool) -> Delays:
    """Compute delays from stamp, publish and log time [ns] and number of each message. Integers, because a damaged bag may have any value."""
    stamped = [row for row in times_ns if row[0] > 0]
    return Delays(
        *_median_and_worst([publish - stamp for stamp, publish, *_ in stamped]),
        *_median_and_worst([log - publish for _, publish, log, _ in times_ns if published]),
        sum(after[0] < before[0] or after[3] < before[3] for before, after in pairwise(stamped))
        if stamped
        else None,
        sum(stamp > log for stamp, _, log, _ in stamped) if stamped else None,
    )


def _median_and_worst(delays_ns: list[int]) -> tuple[float | None, float | None]:
    delays_ms = [delay / _NS_PER_MS for delay in delays_ns]
    return (float(np.median(delays_ms)), max(delays_ms)) if delays_ms else (None, None)


def _begins_with_stamp(recorded: RecordedTopic) -> bool:
    """Whether the messages of a topic begin with a header, as the bag defines their type, or as advnerf does."""
    text = recorded.definition
    try:
        definition = (
            parse_definition(recorded.type, text, recorded.definition_language)
            if text
            else Definition(recorded.type, {})
        )
        return definition.begins_with_header
    except MessageError:
        return False


def _stamp_ns(data: bytes, serialization: str) -> int:
    if len(data) < _STAMP_AT + 8:
        return 0
    little = serialization == ROS1 or data[1] & 1
    seconds, nanoseconds = _STAMP[0 if little else 1].unpack_from(data, _STAMP_AT)
    return int(seconds) * NS_PER_S + int(nanoseconds)
