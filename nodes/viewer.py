"""The viewer node: shows all topics live in Foxglove or Lichtblick, with the published bytes.

It runs a WebSocket server (protocol foxglove.sdk.v1), by default for this computer only. The server only sends, so a browser cannot
command the car. Open the app, connect to ``ws://localhost:8765``, and import the layout ``nodes/foxglove_layout.json``.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from advnerf_core.strict import StrictModel
from nodes.linking.keys import is_loopback
from nodes.runtime.errors import BusError, SecurityError
from nodes.runtime.messages import type_definition
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import TOPICS, status_topic
from nodes.runtime.topics import topic as topic_row

# Messages that wait for a slow browser. If there are more, the oldest is dropped.
_BACKLOG = 64


class ViewerConfig(StrictModel):
    """Configuration of the viewer.

    Attributes:
        host: Address to listen on. Any address other than loopback shows all topics to every computer on the network.
        port: TCP port of the WebSocket; 0 selects a free one.
        open_to_network: Must be true for an address other than loopback, because a WebSocket has no keys.
        topics: Topics to show; none means the whole topic table.
        statuses_of: Nodes whose status is also shown.
    """

    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=0, le=65535)
    open_to_network: bool = False
    topics: tuple[str, ...] | None = None
    statuses_of: tuple[str, ...] = ()


class ViewerNode(Node):
    """Forwards CDR bytes to a WebSocket without decoding."""

    opens = "a web server"
    raw = True

    def __init__(self, config: ViewerConfig) -> None:
        import foxglove

        if not (is_loopback(config.host) or config.open_to_network):
            raise SecurityError(
                f"{config.host} shows all topics to every computer on the network, without keys; use 127.0.0.1 and an ssh tunnel, or set "
                "open_to_network: true"
            )
        self.subscriptions = (
            *(tuple(TOPICS) if config.topics is None else config.topics),
            *map(status_topic, config.statuses_of),
        )
        # Keep a reference: the server sees the channels only as long as the context exists.
        self._context = context = foxglove.Context()
        self._channels = {name: _channel(foxglove, name, context) for name in self.subscriptions}
        self._shown = 0
        try:
            # No capabilities: clients may neither publish, nor call services, nor set parameters.
            self._server = foxglove.start_server(
                name="advnerf",
                host=config.host,
                port=config.port,
                capabilities=[],
                context=context,
                message_backlog_size=_BACKLOG,
            )
        except (OSError, RuntimeError) as error:
            raise BusError(f"cannot serve the viewer on {config.host}:{config.port}: {error}") from error

    @classmethod
    def build(cls, config: ViewerConfig, context: NodeContext) -> ViewerNode:
        """Build the node and start the server."""
        return cls(config)

    @property
    def port(self) -> int:
        """TCP port of the WebSocket."""
        return int(self._server.port)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Show a message."""
        channel = self._channels[topic]
        if channel.has_sinks():  # do not join the pixels without a client
            channel.log(info.raw, log_time=info.receive_real_ns)
            self._shown += 1
        return []

    def status(self) -> tuple[str, str]:
        """Report the port, and the number of shown messages."""
        return (ACTIVE if self._shown else READY), f"ws port {self.port}, {self._shown} messages shown"

    def counters(self) -> dict[str, float]:
        """Report the number of shown messages."""
        return {"shown": float(self._shown)}

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()


def _channel(foxglove: Any, name: str, context: Any) -> Any:
    typename = topic_row(name).type
    schema = foxglove.Schema(name=typename, encoding="ros2msg", data=type_definition(typename).encode())
    return foxglove.Channel(name, schema=schema, message_encoding="cdr", context=context)


if __name__ == "__main__":
    raise SystemExit(run_node_main(ViewerConfig, ViewerNode.build))
