"""The two doors of a link as ZeroMQ sockets: opening with keys and limits, closing, and monitoring of handshakes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from nodes.linking.keys import DRIVE, WATCH, KeyFolder
from nodes.runtime.errors import BusError

# Enough for short bursts of poses and images. Messages that wait longer are stale, and PUB drops new ones while the pipe is full.
LINK_QUEUE = 50
# Larger than every message. The socket disconnects a peer that sends a larger one.
MOST_BYTES = 16 * 2**20
# Internal messages of the two ends: the clock question and the heartbeat.
CLOCK, PULSE = b"_clock", b"_pulse"
_HEARTBEAT_MS, _HEARTBEAT_TIMEOUT_MS = 500, 3000
_UNLISTED = int(zmq.EVENT_HANDSHAKE_FAILED_AUTH)
_ENDED_EARLY = int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
_FAILURES = {
    _UNLISTED: "its key is not on the list",
    int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL): "it has no CURVE key, or the wrong key of this host",
    _ENDED_EARLY: "it ended early",
}


@dataclass(frozen=True)
class LinkConfig:
    """Configuration of one end of a link.

    Attributes:
        address: Address to listen on, or to connect to.
        listens: Whether this end listens.
        watch_port: TCP port on which the listener sends.
        drive_port: TCP port on which the listener receives.
        keys: Key folder. None is allowed only on a loopback address and for watching.
        own: Name of this host's key.
        peer: Name of the listener's key, for the connecting end.
        imports: Topics received from the other end. Other topics are refused.
        exports: Topics sent to the other end.
    """

    address: str
    listens: bool
    watch_port: int
    drive_port: int
    keys: KeyFolder | None
    own: str
    peer: str
    imports: tuple[str, ...]
    exports: tuple[str, ...] = ()

    @property
    def commands(self) -> tuple[str, ...]:
        """Topics sent through the drive door, to the listening end."""
        return self.imports if self.listens else self.exports

    @property
    def drives(self) -> bool:
        """Whether the drive door is used: by a listener with keys, and by a connecting end that exports topics."""
        return self.keys is not None and (self.listens or bool(self.exports))


@dataclass(frozen=True)
class Handshake:
    """An event at a door.

    Attributes:
        right: The door.
        refusal: Where and why a connection was refused; empty otherwise.
        ended: Whether a connection ended.
    """

    right: str
    refusal: str = ""
    ended: bool = False


class LinkSockets:
    """The sockets of one end and their monitors. Not thread-safe: the link's thread owns them.

    Args:
        config: Configuration of the end.
        context: ZeroMQ context of the sockets.
        poller: Poller to which the monitors and the inward door are added.
    """

    def __init__(self, config: LinkConfig, context: zmq.Context[Any], poller: zmq.Poller) -> None:
        self._config, self._context, self._poller = config, context, poller
        self._sockets: dict[str, zmq.Socket[Any]] = {}
        self._monitors: dict[str, zmq.Socket[Any]] = {}
        self._subscribed: set[str] = set()
        # The listener sends through the watch door and receives through the drive door.
        self._in, self._out = (DRIVE, WATCH) if config.listens else (WATCH, DRIVE)

    @property
    def inward(self) -> zmq.Socket[Any] | None:
        """The door that receives messages; None for a listener without keys."""
        return self._sockets.get(self._in)

    @property
    def outward(self) -> zmq.Socket[Any] | None:
        """The door that sends messages; None for an end that only watches."""
        return self._sockets.get(self._out)

    def open(self, right: str) -> None:
        """Open a door; after an error it is closed.

        Raises:
            BusError: Its port is taken.
            OSError, zmq.ZMQError: Descriptors or memory have run out.
        """
        self._sockets[right] = self._context.socket(zmq.SUB if right == self._in else zmq.PUB)
        try:
            self._prepare(self._sockets[right], right)
        except Exception:
            self.close(right)
            raise

    def _prepare(self, socket: zmq.Socket[Any], right: str) -> None:
        config = self._config
        socket.linger = 0
        socket.sndhwm = socket.rcvhwm = LINK_QUEUE
        socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
        socket.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, _HEARTBEAT_TIMEOUT_MS)
        socket.setsockopt(zmq.RECONNECT_IVL, 100)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        socket.setsockopt(zmq.IPV6, ":" in config.address)
        if config.keys is not None:
            self._arm_curve(socket, right)
        self._monitors[right] = socket.get_monitor_socket(
            zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED | sum(_FAILURES)
        )
        self._poller.register(self._monitors[right], zmq.POLLIN)
        if right == self._in:
            socket.subscribe(CLOCK)
            socket.subscribe(PULSE)
            self._subscribed = set()
            self._poller.register(socket, zmq.POLLIN)
        self._attach(socket, config.watch_port if right == WATCH else config.drive_port)

    def close(self, right: str) -> None:
        """Close a door, if it is open, and disconnect its peers."""
        socket, monitor = self._sockets.pop(right, None), self._monitors.pop(right, None)
        for each in (socket, monitor):
            if each in self._poller:
                self._poller.unregister(each)
        if socket is not None and monitor is not None:
            socket.disable_monitor()
            monitor.close(linger=0)
        if socket is not None:
            socket.close(linger=0)

    def close_all(self) -> None:
        """Close all open doors."""
        for right in list(self._sockets):
            self.close(right)

    def follow(self, wanted: frozenset[str]) -> None:
        """Receive exactly these topics from the other end."""
        if self.inward is None:
            return
        for topic in wanted - self._subscribed:
            self.inward.subscribe(topic.encode())
        for topic in self._subscribed - wanted:
            self.inward.unsubscribe(topic.encode())
        self._subscribed = set(wanted)

    def handshakes(self, ready: set[Any]) -> Iterator[Handshake]:
        """Yield the events of the doors whose monitors are ready."""
        for right, monitor in list(self._monitors.items()):
            if monitor not in ready:
                continue
            with contextlib.suppress(zmq.Again):
                while True:
                    number = int(recv_monitor_message(monitor, zmq.NOBLOCK)["event"])
                    refusal = self._refusal(right, number) if number in _FAILURES else ""
                    yield Handshake(right, refusal, number == zmq.EVENT_DISCONNECTED)

    def _refusal(self, right: str, number: int) -> str:
        own, peer = self._config.own, self._config.peer
        if self._config.listens:
            return f"handshake at the {right} door: {_FAILURES[number]}"
        if number == _UNLISTED:
            why = f"our key {own} is not on its list; allow it there with advnerf car keys allow {own} --right {right}"
        elif number == _ENDED_EARLY:
            why = (
                "the connection ended in the handshake: its launch is down behind a tunnel or port forward (start it), or "
                f"advnerf car keys list does not show the same key {peer} on both hosts"
            )
        else:
            why = f"the handshake failed; advnerf car keys list must show the same key {peer} on both hosts"
        return f"at the {right} door of {peer}: {why}"

    def _arm_curve(self, socket: zmq.Socket[Any], right: str) -> None:
        keys, own = self._config.keys, self._config.own
        assert keys is not None
        socket.curve_secretkey = keys.secret(own).encode()
        socket.curve_publickey = keys.public(own).encode()
        if self._config.listens:
            socket.curve_server = True
            # A named domain instead of "*", which pyzmq's authenticator does not treat as a wildcard.
            socket.setsockopt(zmq.ZAP_DOMAIN, right.encode())
            socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        else:
            socket.curve_serverkey = keys.public(self._config.peer).encode()

    def _attach(self, socket: zmq.Socket[Any], port: int) -> None:
        address = f"[{self._config.address}]" if ":" in self._config.address else self._config.address
        endpoint = f"tcp://{address}:{port}"
        if not self._config.listens:
            socket.connect(endpoint)
            return
        deadline = time.monotonic() + 2.0
        while True:
            try:
                socket.bind(endpoint)
                return
            except zmq.ZMQError as error:
                # After a revocation, ZeroMQ's own thread may still be closing the old door.
                if error.errno != zmq.EADDRINUSE or time.monotonic() > deadline:
                    raise BusError(
                        f"cannot listen on {endpoint}: {error.strerror}; is another launch running?"
                    ) from error
                time.sleep(0.02)
