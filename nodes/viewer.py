"""The viewer node: everything on the bus, live in Foxglove or Lichtblick, byte for byte as it was published.

A WebSocket server (protocol foxglove.sdk.v1) on this computer only, unless told otherwise. It speaks and never listens: what a
browser sends moves nothing. Open the app, connect to ``ws://localhost:8765``, import the layout ``nodes/foxglove_layout.json``.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from nodes.linking.keys import is_loopback
from nodes.runtime.errors import BusError, SecurityError
from nodes.runtime.messages import type_definition
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import TOPICS, status_topic
from nodes.runtime.topics import topic as topic_row

# What waits for a slow browser; beyond it the oldest goes.
_BACKLOG = 64


class ViewerConfig(BaseModel):
    """Configuration of the viewer.

    Attributes:
        host: Address to listen on. Others than a loopback address show all topics to everybody in reach.
        port: TCP port of the WebSocket; 0 takes a free one.
        open_to_network: Must be true for an address that is not loopback: there are no keys on a WebSocket.
        topics: What to show; none means all of the topic table.
        statuses_of: Nodes whose status is shown too.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=0, le=65535)
    open_to_network: bool = False
    topics: tuple[str, ...] | None = None
    statuses_of: tuple[str, ...] = ()


class ViewerNode(Node):
    """Passes CDR bytes on to a WebSocket; decodes nothing.

    Args:
        config: Configuration.
    """

    raw = True

    def __init__(self, config: ViewerConfig) -> None:
        import foxglove

        if not (is_loopback(config.host) or config.open_to_network):
            raise SecurityError(
                f"{config.host} shows all topics to everybody in reach, without keys; use 127.0.0.1 and an ssh tunnel, or say "
                "open_to_network: true"
            )
        self.subscriptions = (
            *(tuple(TOPICS) if config.topics is None else config.topics),
            *map(status_topic, config.statuses_of),
        )
        # The server sees the channels of a context only as long as somebody keeps it.
        self._context = context = foxglove.Context()
        self._channels = {name: _channel(foxglove, name, context) for name in self.subscriptions}
        self._shown = 0
        try:
            # No capabilities: clients may neither publish, nor call services, nor set parameters.
            self._server = foxglove.start_server(
                name="advnerf", host=config.host, port=config.port, capabilities=[], context=context,
                message_backlog_size=_BACKLOG,
            )  # fmt: skip
        except (OSError, RuntimeError) as error:
            raise BusError(f"cannot serve the viewer on {config.host}:{config.port}: {error}") from error

    @classmethod
    def build(cls, config: ViewerConfig, context: NodeContext) -> ViewerNode:
        """Start the server."""
        del context  # it needs nothing of the run
        return cls(config)

    @property
    def port(self) -> int:
        """TCP port of the WebSocket."""
        return int(self._server.port)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Show a message."""
        channel = self._channels[topic]
        if channel.has_sinks():  # pixels that nobody looks at are not even joined
            channel.log(info.raw, log_time=info.receive_real_ns)
            self._shown += 1
        return []

    def status(self) -> tuple[str, str]:
        """Where it can be seen."""
        return (ACTIVE if self._shown else READY), f"ws port {self.port}, {self._shown} messages shown"

    def counters(self) -> dict[str, float]:
        """How much was shown."""
        return {"shown": float(self._shown)}

    def close(self) -> None:
        """End the server."""
        self._server.stop()


def _channel(foxglove: Any, name: str, context: Any) -> Any:
    typename = topic_row(name).type
    schema = foxglove.Schema(name=typename, encoding="ros2msg", data=type_definition(typename).encode())
    return foxglove.Channel(name, schema=schema, message_encoding="cdr", context=context)


def main() -> int:
    """Run the node as a process."""
    return run_node_main(ViewerConfig, ViewerNode.build)


if __name__ == "__main__":
    raise SystemExit(main())
