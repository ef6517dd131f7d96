"""The player node: publishes the messages of a bag on the bus, at the recorded speed or another.

Bytes and capture stamps are the recorded ones. Publish times are new, so that receivers see fresh messages. Topics that the topic
table marks ``replay: never`` are not played, under no name: a recording must not move or arm a car.

The player can pause, resume, step message by message, change its speed and stop, controlled by keys in a terminal and by requests on
``/player/control``, which it answers on ``/player/state``. ``/clock`` has the position in the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import Field

from advnerf_core.strict import StrictModel
from nodes.bags.info import BagMessage
from nodes.bags.keys import Keys
from nodes.bags.play import PAUSE, RATE, RESUME, STEP, STOP, TOGGLE, PlayerCommand, Playhead
from nodes.bags.reader import read_info, read_messages, require_readable
from nodes.bags.time_gaps import skipped_gaps
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError, MessageError, NodeFinished
from nodes.runtime.messages import header, stamp_from_ns, types
from nodes.runtime.node import ACTIVE, READY, Inbox, MessageInfo, Node, NodeContext, Now, Out, ReaderThread
from nodes.runtime.process import run_node_main
from nodes.runtime.requests import Answer, AnswerMemory
from nodes.runtime.topics import STATUS_PREFIX, may_replay, status_topic, type_of_topic
from nodes.runtime.topics import topic as topic_row

_CONTROL, _STATE, _CLOCK = "/player/control", "/player/state", "/clock"
# Messages are published at the first tick after they are due, on average up to 2.5 ms late.
_TICK_HZ = 200.0
_FASTER = 1.25
# Time after a stop request in which its sender may repeat it, if it has not received the answer.
_FAREWELL_NS = NS_PER_S // 4


class PlayerConfig(StrictModel):
    """Configuration of the player.

    Attributes:
        bag: Bag folder or ``.mcap`` file.
        rate: Speed relative to the recording.
        loop: Start over at the end.
        start_offset_s: Time to skip at the beginning [s].
        duration_s: Time to play from there [s].
        topics: Topics to play; none means all that may be played.
        remap: New names of topics, by recorded name.
        paused: Start paused.
        clock_hz: Rate of ``/clock`` [Hz]; none for never.
        wait_for: Topics, by their played names, that must have a subscriber before the first message. None waits for a subscriber of
            any topic. An empty list does not wait; messages without a subscriber are lost.
        wait_for_nodes: Nodes that must be ready before the first message: those that only see what others make of it are no subscribers of a
            played topic.
    """

    bag: Path
    rate: float = Field(default=1.0, gt=0)
    loop: bool = False
    start_offset_s: float = Field(default=0.0, ge=0)
    duration_s: float | None = Field(default=None, gt=0)
    topics: list[str] | None = None
    remap: dict[str, str] = Field(default_factory=dict)
    paused: bool = False
    clock_hz: float | None = Field(default=None, gt=0, le=_TICK_HZ)
    wait_for: list[str] | None = None
    wait_for_nodes: list[str] = Field(default_factory=list)


class PlayerNode(Node):
    """Publishes the messages of a bag when they are due.

    Args:
        terminal: File descriptor of a terminal whose keys control the player; None for no keys.
    """

    opens = "another bag"
    subscriptions: tuple[str, ...] = (_CONTROL,)
    tick_rate_hz = _TICK_HZ

    def __init__(
        self, config: PlayerConfig, subscribers: Callable[[str], int], terminal: int | None = None
    ) -> None:
        self._config = config
        self._subscribers = subscribers
        self._info = read_info(config.bag)
        self._topics = _choose_topics(config, [topic.name for topic in self._info.topics])
        self._names = _renamed(config, self._topics)
        unknown = [topic.name for topic in self._info.topics if type_of_topic(topic.name) is None]
        self._left_out = [] if config.topics else [name for name in unknown if name not in self._topics]
        self._kept = [] if config.topics else [t.name for t in self._info.topics if not may_replay(t.name)]
        self._types = {recorded: topic_row(played).type for recorded, played in self._names.items()}
        require_readable(config.bag, self._types)
        self._played_names = tuple(self._names[topic] for topic in self._topics)
        self.publications = (*self._played_names, *((_CLOCK,) if config.clock_hz else ()), _STATE)
        for topic in config.wait_for or ():
            if topic not in self.publications:
                raise BagError(
                    f"cannot wait for subscribers of {topic}, which is not played; played are {', '.join(self.publications)}"
                )
        self._unready = dict.fromkeys(map(status_topic, config.wait_for_nodes))
        self.subscriptions = (_CONTROL, *self._unready)
        self._begin_ns = self._info.start_ns + round(config.start_offset_s * NS_PER_S)
        self._end_ns = self._info.end_ns
        if config.duration_s is not None:
            self._end_ns = min(self._end_ns, self._begin_ns + round(config.duration_s * NS_PER_S))
        self._gaps = skipped_gaps(config.bag)
        self._messages: Iterator[BagMessage] = iter(())
        self._next: BagMessage | None = None
        self._head: Playhead | None = None
        self._clock_due_ns = 0
        self._played, self._trouble = 0, ""
        self._answers = AnswerMemory()
        self._ends_ns: int | None = None
        self._rewind()  # refuse a bag without messages in the wanted part here, and not when a subscriber connects
        self._keys, self._reader = None, None
        if terminal is not None:
            self.inbox = Inbox[str](capacity=16)
            self._keys = Keys(terminal)
            self._reader = ReaderThread(self._keys.read, self.inbox, "keys")
            self._reader.start()

    @classmethod
    def build(cls, config: PlayerConfig, context: NodeContext) -> PlayerNode:
        """Build the node and open the bag."""
        return cls(config, context.subscribers)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Execute a request once, and answer every repeat of it. Note which awaited nodes are ready."""
        if topic != _CONTROL:
            if message.state in (READY, ACTIVE):
                self._unready.pop(topic, None)
            return []
        outs: list[Out] = []
        ask_id = str(message.ask_id)
        if not self._answers.repeat(ask_id):
            try:
                outs = self._obey(PlayerCommand.parse(str(message.command)), now)
            except MessageError as error:
                self._trouble = str(error)
            self._answers.give(Answer(ask_id, not self._trouble, self._trouble or self.status()[1]))
        return [*outs, self._state(now)]

    def receive(self, item: str, now: Now) -> list[Out]:
        """Execute the command of a key."""
        if item in ("faster", "slower"):
            rate = self._head.rate if self._head else self._config.rate
            return self._obey(
                PlayerCommand(RATE, rate * _FASTER if item == "faster" else rate / _FASTER),
                now,
                by_request=False,
            )
        return self._obey(PlayerCommand(item), now, by_request=False)

    def tick(self, now: Now) -> list[Out]:
        """Publish the messages that are due."""
        if self._ends_ns is not None:
            if now.mono_ns >= self._ends_ns:
                raise NodeFinished
            return []
        if self._head is None:
            if self._missing():
                return []
            self._head = Playhead(self._begin_ns, now.mono_ns, self._config.rate, self._config.paused)
        self._head.skip(self._gaps, now.mono_ns)
        due: list[Out] = []
        while (
            not self._head.paused
            and self._next is not None
            and self._next.log_ns <= self._head.time_ns(now.mono_ns)
        ):
            due.append(self._take())
        if self._next is None and not due:
            if not self._config.loop:
                raise NodeFinished
            self._head.jump(self._begin_ns, now.mono_ns)
            self._rewind()
        return self._clock(now) + due

    def status(self) -> tuple[str, str]:
        """Report ready while waiting for subscribers."""
        if self._head is None and (missing := self._missing()):
            return READY, f"waiting for {', '.join(missing)}"
        words = [f"{self._played} messages played"]
        if self._left_out:
            words.append(f"not in the topic table: {', '.join(self._left_out)}")
        if self._kept:
            words.append(f"never played: {', '.join(self._kept)}")
        if self._head is not None and self._head.paused:
            words.append("paused")
        return ACTIVE, "; ".join([*words, *filter(None, [self._trouble])])

    def close(self) -> None:
        """Restore the terminal."""
        if self._reader is not None and self._keys is not None:
            self._reader.stop()
            self._keys.close()

    def _obey(self, command: PlayerCommand, now: Now, by_request: bool = True) -> list[Out]:
        self._trouble = ""
        if command.word == STOP:
            self._ends_ns = now.mono_ns + (_FAREWELL_NS if by_request else 0)
            return []
        if self._head is None:
            self._trouble = "playback has not started yet"
            return []
        if command.word in (PAUSE, RESUME, TOGGLE):
            paused = not self._head.paused if command.word == TOGGLE else command.word == PAUSE
            self._head.pause(paused, now.mono_ns)
        elif command.word == RATE:
            self._head.set_rate(command.number, now.mono_ns)
        elif command.word == STEP:
            return self._step(int(command.number), now)
        return []

    def _state(self, now: Now) -> Out:
        answer, head = self._answers.last, self._head
        message = types.PlayerState(
            header=header(now.real_ns),
            answered_id=answer.ask_id,
            granted=answer.granted,
            answer=answer.text,
            paused=self._config.paused if head is None else head.paused,
            rate=self._config.rate if head is None else head.rate,
            playing=stamp_from_ns(0 if head is None else head.time_ns(now.mono_ns)),
        )
        return Out(_STATE, message)

    def _step(self, count: int, now: Now) -> list[Out]:
        """Publish the next messages at once and pause after them."""
        assert self._head is not None
        self._head.pause(True, now.mono_ns)
        outs = []
        for _ in range(count):
            if self._next is None:
                break
            self._head.jump(self._next.log_ns, now.mono_ns)
            outs.append(self._take())
        self._clock_due_ns = now.mono_ns
        return self._clock(now) + outs

    def _take(self) -> Out:
        message = self._next
        assert message is not None
        self._played += 1
        self._advance()
        return Out(self._names[message.topic], message.cdr)

    def _advance(self) -> None:
        self._next = next(self._messages, None)
        if self._next is not None and self._next.log_ns > self._end_ns:
            self._next = None

    def _clock(self, now: Now) -> list[Out]:
        if self._config.clock_hz is None or self._head is None or now.mono_ns < self._clock_due_ns:
            return []
        period_ns = round(NS_PER_S / self._config.clock_hz)
        late_ns = now.mono_ns - self._clock_due_ns
        self._clock_due_ns = (
            self._clock_due_ns + period_ns if late_ns < period_ns else now.mono_ns + period_ns
        )
        return [Out(_CLOCK, types.Clock(clock=stamp_from_ns(self._head.time_ns(now.mono_ns))))]

    def _missing(self) -> list[str]:
        wanted = self._config.wait_for
        missing = [
            topic
            for topic in (self._played_names if wanted is None else wanted)
            if self._subscribers(topic) == 0
        ]
        if wanted is None and len(missing) < len(self._played_names):
            missing = []
        nodes = [f"the node {topic.removeprefix(STATUS_PREFIX)}" for topic in self._unready]
        return [*(f"subscribers of {topic}" for topic in missing), *nodes]

    def _rewind(self) -> None:
        self._messages = read_messages(
            self._config.bag, self._topics, self._config.start_offset_s, self._types
        )
        self._advance()
        if self._next is None:
            span = f"{self._config.start_offset_s} s"
            span += "" if self._config.duration_s is None else f" within {self._config.duration_s} s"
            raise BagError(f"{self._info.path} has no message of {', '.join(self._topics)} after {span}")


def _renamed(config: PlayerConfig, topics: list[str]) -> dict[str, str]:
    """Played name of each topic, by recorded name."""
    for old, new in config.remap.items():
        if old not in topics:
            raise BagError(
                f"cannot play {old} as {new}, because {old} is not played; played are {', '.join(topics)}"
            )
    names = {topic: config.remap.get(topic, topic) for topic in topics}
    _require_free(names.values())
    for name in names.values():
        topic_row(name)  # only topics of the table can be published
        if len(sources := [topic for topic, played in names.items() if played == name]) > 1:
            raise BagError(
                f"{' and '.join(sources)} would both be played as {name}; select one with --topics"
            )
    return names


def _choose_topics(config: PlayerConfig, recorded: list[str]) -> list[str]:
    if config.topics is None:
        _require_free(name for name in recorded if name in config.remap)
        chosen = [
            name
            for name in recorded
            if may_replay(name) and (type_of_topic(name) is not None or name in config.remap)
        ]
    else:
        chosen = list(dict.fromkeys(config.topics))
        if unknown := [name for name in chosen if name not in recorded]:
            raise BagError(f"{config.bag} has no topic {', '.join(unknown)}; it has {', '.join(recorded)}")
        _require_free(chosen)
    if not chosen:
        raise BagError(
            f"{config.bag} has nothing to play; it has {', '.join(recorded) or 'no message'}. Only topics of the topic table can be "
            "played; rename others with --remap OLD:=NEW"
        )
    return chosen


def _require_free(names: Iterable[str]) -> None:
    if never := [name for name in names if not may_replay(name)]:
        raise BagError(
            f"expected topics that a recording may publish, got {', '.join(never)}: a recording must not move or arm a car, under no name."
            " Run nodes over these messages with advnerf bag replay, which has no bus"
        )


if __name__ == "__main__":
    raise SystemExit(run_node_main(PlayerConfig, PlayerNode.build))
