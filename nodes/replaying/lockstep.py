"""The engine of lockstep replay: feeds nodes message by message and runs their ticks on a grid of recorded time."""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nodes.bags.info import BagMessage
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.errors import BagError, MessageError, NodeFinished
from nodes.runtime.messages import decode, encode, header, type_name, types
from nodes.runtime.node import MessageInfo, Node, Out
from nodes.runtime.topics import STATUS_PREFIX, STATUS_RATE_HZ, status_topic
from nodes.runtime.topics import topic as topic_row

# Limit of messages caused by one message, because nodes that answer each other for ever would block the replay.
_CASCADE_LIMIT = 10_000


class BagClock:
    """The clock of a replay. Both of its clocks show the recording's real time and advance only with the messages."""

    def __init__(self, real_ns: int = 0) -> None:
        self._ns = real_ns

    def now(self) -> Now:
        """Read the current time of the recording."""
        return Now(self._ns, self._ns)

    def move_to(self, real_ns: int) -> Now:
        """Advance to a time [ns since 1970]. The clock never goes back."""
        self._ns = max(self._ns, real_ns)
        return self.now()


@dataclass
class Summary:
    """Summary of a replay.

    Attributes:
        messages: Number of messages fed to the nodes.
        made: Number of messages published by the nodes, by topic, without statuses.
        refused: Last reason why a message could not be decoded, by topic.
        digest: SHA-256 over topic, time and bytes of all published messages in order, without statuses.
        duration_s: Length of the recording [s].
        counters: Counters of the nodes at the end, by node.
    """

    messages: int = 0
    made: Counter[str] = field(default_factory=Counter)
    refused: dict[str, str] = field(default_factory=dict)
    digest: str = ""
    duration_s: float = 0.0
    counters: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass
class _TopicStream:
    """Sequence numbers of one recorded topic. Gaps are losses, and a decrease means another publisher."""

    instance_id: int = 1
    sequence: int | None = None

    def take(self, sequence: int) -> int:
        """Note a message. Returns the number of messages lost before it."""
        last, self.sequence = self.sequence, sequence
        if last is not None and sequence <= last:
            self.instance_id += 1
            return 0
        return 0 if last is None else sequence - last - 1


@dataclass
class _Timer:
    due_ns: int
    period_ns: int
    node: str
    is_status: bool


class Lockstep:
    """Runs nodes on recorded time.

    Args:
        nodes: Nodes by name, in the order in which they get a message.
        clock: The clock they were built with.
        start_ns: Time of the first tick of all of them [ns since 1970].
    """

    def __init__(self, nodes: Mapping[str, Node], clock: BagClock, start_ns: int) -> None:
        self.summary = Summary()
        self.made_topics = {topic for node in nodes.values() for topic in node.publications} | set(
            map(status_topic, nodes)
        )
        self._nodes = dict(nodes)
        self._clock = clock
        self._listeners: dict[str, list[str]] = {}
        for name, node in nodes.items():
            for topic in node.subscriptions:
                self._listeners.setdefault(topic, []).append(name)
        self._hash = hashlib.sha256()
        self._streams: dict[str, _TopicStream] = {}
        self._sequences: Counter[str] = Counter()
        self._next_due_ns = start_ns
        self._timers = [
            _Timer(start_ns, round(NS_PER_S / node.tick_rate_hz), name, False)
            for name, node in nodes.items()
            if node.tick_rate_hz
        ]
        self._timers += [_Timer(start_ns, round(NS_PER_S / STATUS_RATE_HZ), name, True) for name in nodes]

    @property
    def heard_topics(self) -> set[str]:
        """Topics to which at least one node subscribes."""
        return set(self._listeners)

    def feed(self, message: BagMessage) -> list[BagMessage]:
        """Advance to the time of a message and feed it to the nodes. Returns the messages that they publish, in order."""
        now = self._clock.move_to(message.log_ns)
        lost = self._streams.setdefault(message.topic, _TopicStream()).take(message.sequence)
        self.summary.messages += 1
        return self._spread(deque([(message, lost)]), now)

    def advance_to(self, real_ns: int) -> list[BagMessage]:
        """Run the ticks and statuses that are due by a time [ns since 1970]."""
        made: list[BagMessage] = []
        if real_ns < self._next_due_ns:
            return made
        while self._timers:
            timer = min(self._timers, key=lambda timer: timer.due_ns)
            self._next_due_ns = timer.due_ns
            if timer.due_ns > real_ns:
                break
            now = self._clock.move_to(timer.due_ns)
            timer.due_ns += timer.period_ns
            node = self._nodes.get(timer.node)
            if node is None:
                self._timers.remove(timer)
                continue
            outs = (
                [self._status(timer.node, node, now)]
                if timer.is_status
                else self._ask(timer.node, now, node.tick)
            )
            made += self._publish(timer.node, outs, now)
        return made

    def jump(self, before_ns: int, after_ns: int) -> list[BagMessage]:
        """Run the ticks that are due before a gap of the recording, and let the next ones be due after it."""
        made = self.advance_to(before_ns)
        for timer in self._timers:
            late_ns = max(0, after_ns - timer.due_ns)
            timer.due_ns += -(-late_ns // timer.period_ns) * timer.period_ns
        self._next_due_ns = min((timer.due_ns for timer in self._timers), default=after_ns)
        return made

    def finish(self) -> Summary:
        """Return the summary, after the last message."""
        self.summary.digest = self._hash.hexdigest()
        self.summary.counters = {name: node.counters() for name, node in self._nodes.items()}
        return self.summary

    def _publish(self, name: str, outs: list[Out], now: Now) -> list[BagMessage]:
        messages = [self._message(name, out, now) for out in outs]
        return messages + self._spread(deque((message, 0) for message in messages), now)

    def _spread(self, waiting: deque[tuple[BagMessage, int]], now: Now) -> list[BagMessage]:
        """Pass messages to their subscribers, then the messages that these publish, until there are none left."""
        made: list[BagMessage] = []
        while waiting:
            message, lost = waiting.popleft()
            decoded: Any = None
            for name in self._listeners.get(message.topic, ()):
                node = self._nodes.get(name)
                if node is None:  # it has finished
                    continue
                if decoded is None and not node.raw:
                    try:
                        decoded = decode(topic_row(message.topic).type, message.cdr)
                    except MessageError as error:
                        self.summary.refused[message.topic] = str(error)
                        break
                given = None if node.raw else decoded
                outs = self._ask(name, now, node.handle, message.topic, given, self._info(message, lost, now))
                new = [self._message(name, out, now) for out in outs]
                made += new
                waiting.extend((entry, 0) for entry in new)
            if len(made) > _CASCADE_LIMIT:
                raise BagError(
                    f"{', '.join(self._nodes)} answer each other endlessly on {message.topic}; replay fewer of them"
                )
        return made

    def _ask(self, name: str, now: Now, call: Callable[..., list[Out]], *arguments: Any) -> list[Out]:
        try:
            return call(*arguments, now)
        except NodeFinished:
            del self._nodes[name]
            return []
        except Exception as error:  # any error is reported with its place in the bag
            on = f" on {arguments[0]}" if arguments else ""
            raise BagError(
                f"{name} failed at {now.real_ns} ns{on}: {type(error).__name__}: {error}; advnerf --debug replay shows the traceback"
            ) from error

    def _message(self, name: str, out: Out, now: Now) -> BagMessage:
        topic, content = out
        if topic not in self.made_topics:
            raise MessageError(
                f"{name} sends {topic}, but declares only {', '.join(self._nodes[name].publications)}"
            )
        if not isinstance(content, bytes | memoryview):
            if type_name(content) != topic_row(topic).type:
                raise MessageError(
                    f"expected {topic_row(topic).type} on {topic}, got {type_name(content)} from {name}"
                )
            content = encode(content)
        message = BagMessage(topic, bytes(content), now.real_ns, now.real_ns, self._sequences[topic])
        self._sequences[topic] += 1
        if not topic.startswith(STATUS_PREFIX):
            self.summary.made[topic] += 1
            self._hash.update(b"%s\0%d %d\0" % (topic.encode(), message.log_ns, len(message.cdr)))
            self._hash.update(message.cdr)
        return message

    def _info(self, message: BagMessage, lost: int, now: Now) -> MessageInfo:
        stream = self._streams.get(message.topic)
        return MessageInfo(
            publish_mono_ns=message.publish_ns,
            receive_mono_ns=now.mono_ns,
            sequence=message.sequence,
            raw=message.cdr,
            publish_real_ns=message.publish_ns,
            receive_real_ns=now.real_ns,
            lost=lost,
            instance_id=stream.instance_id if stream else 1,
        )

    def _status(self, name: str, node: Node, now: Now) -> Out:
        # Without counters, because some depend on the speed of this machine.
        state, text = node.status()
        status = types.NodeStatus(
            header=header(now.real_ns),
            node=name,
            pid=0,
            state=state,
            text=text,
            subscriptions=list(node.subscriptions),
            publications=list(node.publications),
            subscribers=np.zeros(len(node.publications), np.uint32),
            counter_names=[],
            counter_values=np.zeros(0),
        )
        return Out(status_topic(name), status)
