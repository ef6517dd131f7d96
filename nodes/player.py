"""The player node: a bag back onto the bus, at its own pace or another.

The bytes and the capture stamps are those of the recording; publish times are new, so that receivers see fresh messages.
Statuses and requests (to arm, for an attack) stay in the bag unless they are asked for: a recording must not arm a car.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from nodes.runtime.bag_read import BagMessage, read_info, read_messages, require_our_types
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError, NodeFinished
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out, run_node_main
from nodes.runtime.topics import STATUS_PREFIX

_REQUESTS = ("/arm", "/attack/request", "/attack/cancel")
# Messages leave at the first tick after they are due, so they are up to 2.5 ms late on average.
_TICK_HZ = 200.0


class PlayerConfig(BaseModel):
    """Configuration of the player.

    Attributes:
        bag: Bag folder or ``.mcap`` file.
        rate: Speed relative to the recording.
        loop: Begin again at the end.
        start_offset_s: Leave out so much of the beginning [s].
        topics: What to play; none means all but statuses and requests.
        wait_for: Topics that must have a subscriber before the first message; none means that one of any topic will do,
            an empty list means do not wait, and lose what is sent before a subscriber is there.
    """

    model_config = ConfigDict(extra="forbid")

    bag: Path
    rate: float = Field(default=1.0, gt=0)
    loop: bool = False
    start_offset_s: float = Field(default=0.0, ge=0)
    topics: list[str] | None = None
    wait_for: list[str] | None = None


class PlayerNode(Node):
    """Publishes the messages of a bag when they are due.

    Args:
        config: Configuration.
        subscribers: Number of subscribers of a topic.
    """

    tick_rate_hz = _TICK_HZ

    def __init__(self, config: PlayerConfig, subscribers: Callable[[str], int]) -> None:
        self._config = config
        self._subscribers = subscribers
        self._info = read_info(config.bag)
        self.publications = tuple(_choose_topics(config, [topic.name for topic in self._info.topics]))
        require_our_types(config.bag, self.publications)
        for topic in config.wait_for or ():
            if topic not in self.publications:
                raise BagError(
                    f"cannot wait for subscribers of {topic}, it is not played; played are {', '.join(self.publications)}"
                )
        self._messages: Iterator[BagMessage] = iter(())
        self._next: BagMessage | None = None
        self._begin_bag_ns = 0
        self._begin_mono_ns: int | None = None
        self._played = 0

    @classmethod
    def build(cls, config: PlayerConfig, context: NodeContext) -> PlayerNode:
        """Open the bag."""
        return cls(config, context.subscribers)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """A player hears nothing."""
        return []

    def tick(self, now: Now) -> list[Out]:
        """Publish what is due."""
        if self._begin_mono_ns is None:
            if self._missing():
                return []
            self._rewind(now)
        due: list[Out] = []
        while self._next is not None and self._next.log_ns <= self._bag_time_ns(now):
            due.append(Out(self._next.topic, self._next.cdr))
            self._next = next(self._messages, None)
        self._played += len(due)
        if self._next is None and not due:
            if not self._config.loop:
                raise NodeFinished
            self._rewind(now)
        return due

    def status(self) -> tuple[str, str]:
        """Ready while it waits for subscribers."""
        if self._begin_mono_ns is None and (missing := self._missing()):
            return READY, f"waits for subscribers of {', '.join(missing)}"
        return ACTIVE, f"{self._played} messages played"

    def _missing(self) -> list[str]:
        wanted = self._config.wait_for
        missing = [
            topic for topic in (self.publications if wanted is None else wanted) if self._subscribers(topic) == 0
        ]
        return [] if wanted is None and len(missing) < len(self.publications) else missing

    def _rewind(self, now: Now) -> None:
        self._messages = read_messages(self._config.bag, self.publications, self._config.start_offset_s)
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(
                f"{self._info.path} has no message of {', '.join(self.publications)} after {self._config.start_offset_s} s"
            )
        self._begin_bag_ns = self._info.start_ns + round(self._config.start_offset_s * NS_PER_S)
        self._begin_mono_ns = now.mono_ns

    def _bag_time_ns(self, now: Now) -> int:
        assert self._begin_mono_ns is not None
        return self._begin_bag_ns + round((now.mono_ns - self._begin_mono_ns) * self._config.rate)


def _choose_topics(config: PlayerConfig, recorded: list[str]) -> list[str]:
    if config.topics is None:
        chosen = [name for name in recorded if name not in _REQUESTS and not name.startswith(STATUS_PREFIX)]
    else:
        chosen = list(dict.fromkeys(config.topics))
        if unknown := [name for name in chosen if name not in recorded]:
            raise BagError(f"{config.bag} has no topic {', '.join(unknown)}; it has {', '.join(recorded)}")
    if not chosen:
        raise BagError(f"{config.bag} has nothing to play; it has {', '.join(recorded) or 'no message'}")
    return chosen


def main() -> int:
    """Run the node as a process."""
    return run_node_main(PlayerConfig, PlayerNode.build)


if __name__ == "__main__":
    raise SystemExit(main())
