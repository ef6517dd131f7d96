"""The gateway node: the only process of a host that communicates with the other host.

It sends this host's exported topics to the other host and publishes the imported ones, so that no other node needs to know about
hosts. The listening end (the car) also measures the offset of the other host's clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from nodes.linking.keys import DRIVE, WATCH, KeyFolder, require_address, require_name
from nodes.linking.link import Inbound, Link, LinkConfig, Offset
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import SecurityError
from nodes.runtime.messages import header, type_hash_prefix, types
from nodes.runtime.node import ACTIVE, FAULT, READY, Inbox, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import topic as topic_row
from nodes.runtime.wire import Meta

OFFSET_TOPIC = "/clock/offset"
_TICK_HZ = 10.0
_INBOX = 400
# Duration of three clock questions of the listener.
_SILENCE_S = 0.8


class GatewayConfig(StrictModel):
    """Configuration of the gateway.

    Attributes:
        listen: Address to listen on, for the end on the car.
        connect: Address of the listening host, for the other end.
        watch_port: TCP port on which the listener sends.
        drive_port: TCP port on which the listener receives.
        keys: Key folder. None is allowed only on a loopback address; then the link sends no topic to the listening end.
        key: Name of this host's key.
        peer_key: Name of the listener's key, for the connecting end.
        exports: Topics of this host that are sent to the other host.
        imports: Topics of the other host that are published here.
    """

    listen: str | None = None
    connect: str | None = None
    watch_port: int = Field(default=5570, ge=1024, le=65535)
    drive_port: int = Field(default=5571, ge=1024, le=65535)
    keys: Path | None = None
    key: str = "robot"
    peer_key: str = "robot"
    exports: tuple[str, ...] = ()
    imports: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_end(self) -> GatewayConfig:
        if (self.listen is None) == (self.connect is None):
            raise ValueError("expected either listen or connect; give exactly one of them")
        try:
            require_address(self.listen or self.connect or "")
            for name in (self.key, self.peer_key):
                require_name(name)
        except SecurityError as error:
            raise ValueError(str(error)) from None
        if self.watch_port == self.drive_port:
            raise ValueError(f"expected two ports, got watch_port and drive_port {self.watch_port}")
        for name in (*self.exports, *self.imports):
            topic_row(name)
        if both := set(self.exports) & set(self.imports):
            raise ValueError(
                f"{', '.join(sorted(both))} cannot be both exported and imported, because messages would go in circles; remove one"
            )
        return self

    def link(self) -> LinkConfig:
        """Configuration of the link."""
        return LinkConfig(
            self.listen or self.connect or "",
            self.listen is not None,
            self.watch_port,
            self.drive_port,
            None if self.keys is None else KeyFolder(self.keys),
            self.key,
            self.peer_key,
            self.imports,
            self.exports,
        )


class GatewayNode(Node):
    """Carries messages between the bus of this host and the link."""

    opens = "a link to another host"
    raw = True
    tick_rate_hz = _TICK_HZ

    def __init__(self, config: GatewayConfig, subscribers: Callable[[str], int]) -> None:
        self.subscriptions = config.exports
        self.publications = (*config.imports, *((OFFSET_TOPIC,) if config.listen is not None else ()))
        self.inbox: Inbox[Inbound | Offset] = Inbox(_INBOX)
        self._imports, self._subscribers = config.imports, subscribers
        self._prefixes = {name: type_hash_prefix(topic_row(name).type) for name in config.exports}
        self._sent = self._taken = 0
        self._offset: Offset | None = None
        self._watched_only = config.listen is not None and config.keys is None
        self._link = Link(config.link(), self.inbox)

    @classmethod
    def build(cls, config: GatewayConfig, context: NodeContext) -> GatewayNode:
        """Build the node and open the link."""
        return cls(config, context.subscribers)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Send a message of this host to the other host."""
        meta = Meta(
            info.publish_mono_ns, info.publish_real_ns, info.sequence, self._prefixes[topic], info.instance_id
        )
        self._sent += self._link.send(topic, meta, info.raw)
        return []

    def receive(self, item: Inbound | Offset, now: Now) -> list[Out]:
        """Publish a message from the other host."""
        if isinstance(item, Inbound):
            self._taken += 1
            return [Out(item.topic, item.message)]
        self._offset = item
        message = types.ClockOffset(
            header=header(now.real_ns),
            peer=item.peer,
            offset_s=item.best.offset_s,
            error_s=item.best.round_trip_s / 2,
            round_trip_s=item.newest.round_trip_s,
        )
        return [Out(OFFSET_TOPIC, message)]

    def tick(self, now: Now) -> list[Out]:
        """Subscribe only to topics of the other host that have subscribers here."""
        self._link.want(frozenset(name for name in self._imports if self._subscribers(name) > 0))
        return []

    def status(self) -> tuple[str, str]:
        """Report ready without messages from the other host. The nodes that need them report their own faults.

        A door of the other host that refuses this one is a fault. The right to drive includes watching, so its door is named first.
        """
        if refusal := self._link.refusal(DRIVE) or self._link.refusal(WATCH):
            return FAULT, f"refused {refusal}"
        heard_ns = self._link.heard_mono_ns
        if heard_ns is None and self._watched_only:
            return ACTIVE, f"{self._sent} messages sent; without keys the other host can only watch"
        if heard_ns is None:
            return READY, "the other host has not been heard yet"
        silence_s = (time.monotonic_ns() - heard_ns) / NS_PER_S
        if silence_s > _SILENCE_S:
            return READY, f"the other host has been silent for {silence_s:.1f} s"
        clock = (
            "" if self._offset is None else f", its clock is {self._offset.best.offset_s * 1e3:+.1f} ms off"
        )
        return ACTIVE, f"{self._sent} messages sent, {self._taken} taken{clock}"

    def counters(self) -> dict[str, float]:
        """Report forwarded and refused messages."""
        counters = {
            "sent": float(self._sent),
            "taken": float(self._taken),
            "refused": float(self._link.refused),
        }
        if self._offset is not None:
            counters["clock_offset_s"] = self._offset.best.offset_s
            counters["round_trip_s"] = self._offset.newest.round_trip_s
        return counters

    def close(self) -> None:
        """Close the link."""
        self._link.close()


if __name__ == "__main__":
    raise SystemExit(run_node_main(GatewayConfig, GatewayNode.build))
