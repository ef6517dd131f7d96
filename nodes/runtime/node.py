"""What a node is: a pure class that turns messages into messages. Sockets, signals and rates are the loop's business.

The same class runs as a process (`nodes.runtime.process.run_node_main`), inside a test, and in lockstep replay, because everything it needs is
handed to it: messages, time, and what its constructor got.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from nodes.runtime.clock import Clock, Now
from nodes.runtime.inbox import Inbox, ReaderThread
from nodes.runtime.wire import MessageInfo

__all__ = ["Inbox", "MessageInfo", "Node", "NodeContext", "Now", "Out", "ReaderThread"]

STARTING, READY, ACTIVE, FAULT = "starting", "ready", "active", "fault"


class Out(NamedTuple):
    """A message to publish.

    Attributes:
        topic: One of the node's publications.
        message: A message of the topic's type, or its CDR bytes, which are passed on unchanged.
    """

    topic: str
    message: Any


@dataclass(frozen=True)
class NodeContext:
    """What a node's ``build`` is given besides its configuration.

    Attributes:
        name: Name of the node in the launch file.
        run_dir: Folder of the run.
        clock: The clock to read wherever time is needed outside `Node.handle` and `Node.tick`.
        subscribers: How many subscribers a topic of this node has.
    """

    name: str
    run_dir: Path
    clock: Clock
    subscribers: Callable[[str], int] = field(default=lambda topic: 0)


class Node(ABC):
    """Base of all nodes. Not thread-safe: only its loop calls it.

    Attributes:
        subscriptions: Topics it listens to.
        publications: Topics it may send.
        tick_rate_hz: How often `tick` is called [Hz]; None for never.
        inbox: Queue through which its driver threads hand it data; items come to `receive` at once.
        raw: Do not decode: `handle` gets None as message, and the bytes in ``info.raw``.
        queues: Topics of which it wants every message, with the length of the queue, whatever the topic table says.
    """

    subscriptions: Sequence[str] = ()
    publications: Sequence[str] = ()
    tick_rate_hz: float | None = None
    inbox: Inbox[Any] | None = None
    raw: bool = False
    queues: Mapping[str, int] = {}

    @abstractmethod
    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """React to a message; its arrays are read-only."""

    def receive(self, item: Any, now: Now) -> list[Out]:
        """React to an item of the inbox."""
        raise NotImplementedError(f"{type(self).__name__} has an inbox, but no receive()")

    def tick(self, now: Now) -> list[Out]:
        """Called at `tick_rate_hz` on an absolute schedule; missed ticks are skipped and counted."""
        del now  # most nodes only react
        return []

    def status(self) -> tuple[str, str]:
        """State (``ready``: waiting for something, ``active``: at work, ``fault``) and a short text for a person."""
        return ACTIVE, ""

    def counters(self) -> dict[str, float]:
        """Numbers to report with the status."""
        return {}

    def close(self) -> None:  # noqa: B027 - most nodes have nothing to let go
        """Make the device safe and let it go. Called once, also after an exception."""
