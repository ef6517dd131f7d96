"""The base class of nodes, which turn messages into messages. The loop handles sockets, signals and rates.

A node gets messages and time as arguments and everything else through its constructor. So the same class runs as a process
(`nodes.runtime.process.run_node_main`), in a test, and in lockstep replay.
"""

from __future__ import annotations

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
    """Arguments of a node's ``build`` besides its configuration.

    Attributes:
        name: Name of the node in the launch file.
        run_dir: Folder of the run.
        clock: The clock to read outside `Node.handle` and `Node.tick`.
        subscribers: Returns the number of subscribers of a topic of this node.
    """

    name: str
    run_dir: Path
    clock: Clock
    subscribers: Callable[[str], int] = field(default=lambda topic: 0)


class Node:
    """Base class of nodes. It is not thread-safe: only its loop calls it.

    Attributes:
        subscriptions: Topics that the node subscribes to.
        publications: Topics that the node may publish.
        tick_rate_hz: Rate at which `tick` is called [Hz]; None for never.
        inbox: Queue for data from driver threads. Its items are passed to `receive` at once.
        raw: Do not decode messages: `handle` gets None as message, and the bytes in ``info.raw``.
        queues: Queue length by topic, for topics whose every message the node needs. It overrides the topic table.
        blind: The node takes only the stamps of the images that it gets, so that no attack can change what it commands.
        opens: What the node opens besides the files that it reads, for example a device. Only a node that opens nothing can be replayed.
    """

    subscriptions: Sequence[str] = ()
    publications: Sequence[str] = ()
    tick_rate_hz: float | None = None
    inbox: Inbox[Any] | None = None
    raw: bool = False
    queues: Mapping[str, int] = {}
    blind: bool = False
    opens: str = ""

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Handle a message, whose arrays are read-only, and return the messages to publish."""
        raise NotImplementedError(f"{type(self).__name__} has subscriptions but no handle(); implement it")

    def receive(self, item: Any, now: Now) -> list[Out]:
        """Handle an item of the inbox and return the messages to publish."""
        raise NotImplementedError(f"{type(self).__name__} has an inbox but no receive(); implement it")

    def tick(self, now: Now) -> list[Out]:
        """Run a periodic step at `tick_rate_hz` on an absolute schedule. Missed ticks are skipped and counted."""
        return []

    def status(self) -> tuple[str, str]:
        """Return the state (``ready``: waiting for input, ``active``: working, ``fault``) and a short text."""
        return ACTIVE, ""

    def counters(self) -> dict[str, float]:
        """Return the numbers to report with the status."""
        return {}

    def close(self) -> None:
        """Make the device safe and release it. Called once, also after an exception."""
