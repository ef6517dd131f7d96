"""The link between two hosts: CURVE over TCP, with one door (port) to watch and one to drive.

One host listens, the other connects. Messages of the listener leave through its watch door. Messages of the other host enter through
the drive door, which admits only the keys on its list. Without keys there is no drive door. Every message is checked before it is
decoded. The sockets belong to one thread, which passes the messages to an `Inbox`.
"""

from __future__ import annotations

import contextlib
import os
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import zmq

from nodes.linking.clock_offset import Exchange, OffsetFilter
from nodes.linking.doors import Doorkeeper, RefusalLog
from nodes.linking.keys import DRIVE, WATCH, require_keys
from nodes.linking.sockets import CLOCK, LINK_QUEUE, MOST_BYTES, PULSE, Handshake, LinkConfig, LinkSockets
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.descriptors import has_run_out
from nodes.runtime.errors import MessageError
from nodes.runtime.inbox import Inbox
from nodes.runtime.messages import decode
from nodes.runtime.topics import topic as topic_row
from nodes.runtime.wire import Meta, Relayed, pack_meta, unpack

_OUTBOX = 256
_POLL_MS = 20
_LOOK_S = 0.5
_PING_S = 0.2
_KNOCK_S = 1.0
# Many attempts: a door that has refused none for so long is gone, and so is its host.
_REFUSED_S = 15.0
_LARGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "advnerf_msgs/msg/FileChunk")
_SMALL_BYTES = 64 * 2**10
# TCP detects a lost packet when a later one arrives, and otherwise only after 200 ms or more, which is the lifetime of a command. So
# another message must follow soon after each one. Topics without subscribers are not sent, so this heartbeat is.
_PULSE_S = 0.015
_PING, _PONG = struct.Struct("<Q"), struct.Struct("<QQQ")


@dataclass(frozen=True)
class Inbound:
    """A checked message from the other host, with its publish time on the local clock."""

    topic: str
    message: Relayed


@dataclass(frozen=True)
class Offset:
    """Offset of the other host's clock."""

    peer: str
    best: Exchange
    newest: Exchange


class Link:
    """One end of a link, running in its own thread.

    Args:
        config: End, addresses and keys of the link.
        inbox: Receives `Inbound`, `Offset`, and the exception that ends the link.

    Attributes:
        heard_mono_ns: Time of the last message from the other end; None before the first.
    """

    def __init__(self, config: LinkConfig, inbox: Inbox[Inbound | Offset]) -> None:
        require_keys(config.address, config.keys, config.commands)
        self._config, self._inbox = config, inbox
        self.heard_mono_ns: int | None = None
        self._outbox: deque[list[bytes]] = deque(maxlen=_OUTBOX)
        self._wanted: frozenset[str] = frozenset()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._stopping = False
        self._log = RefusalLog()
        self._locked_out: dict[str, float] = {}
        self._refusals: dict[str, tuple[str, float]] = {}
        self._offsets: dict[str, OffsetFilter] = {}
        self._context: zmq.Context[Any] = zmq.Context()
        self._poller = zmq.Poller()
        self._poller.register(self._wake, zmq.POLLIN)
        self._keeper: Doorkeeper | None = None
        self._doors = LinkSockets(config, self._context, self._poller)
        self._thread = threading.Thread(target=self._run, name="link", daemon=True)
        try:
            self._open()
        except BaseException:
            self._close_all()
            raise
        self._thread.start()

    @property
    def refused(self) -> int:
        """Number of refused handshakes and messages."""
        return self._log.refused

    def refusal(self, right: str) -> str:
        """Where and why the listening end refuses this one's connections to a door at present; empty if it does not."""
        text, heard_s = self._refusals.get(right, ("", 0.0))
        return text if time.monotonic() - heard_s < _REFUSED_S else ""

    def send(self, topic: str, meta: Meta, cdr: bytes) -> bool:
        """Send a message to the other end without blocking. If the link is too slow, the oldest message is dropped.

        Returns:
            Whether the other end has a chance to get it: not while it refuses the connections of this one.
        """
        self._outbox.append([topic.encode(), pack_meta(meta), cdr])
        os.eventfd_write(self._wake, 1)
        return not self.refusal(DRIVE)

    def want(self, topics: frozenset[str]) -> None:
        """Receive only these imports from now on, so that topics without readers are not sent."""
        self._wanted = topics

    def close(self) -> None:
        """Close the link."""
        self._stopping = True
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        os.close(self._wake)

    def _open(self) -> None:
        if self._config.listens and self._config.keys is not None:
            # Started before any door opens: without an authenticator ZeroMQ admits every key.
            self._keeper = Doorkeeper(self._context, self._config.keys, self._log)
            self._poller.register(self._keeper.socket, zmq.POLLIN)
        self._doors.open(WATCH)
        if self._config.drives:
            self._doors.open(DRIVE)

    def _close_all(self) -> None:
        self._doors.close_all()
        if self._keeper is not None:
            self._keeper.socket.close(linger=0)
        self._context.term()

    def _run(self) -> None:
        looked = pinged = pulsed = 0.0
        try:
            while not self._stopping:
                ready = {entry for entry, _ in self._poller.poll(_POLL_MS)}
                self._drain_outbox(ready)
                if self._keeper is not None and self._keeper.socket in ready:
                    self._keeper.judge()
                for event in self._doors.handshakes(ready):
                    self._note(event)
                inward = self._doors.inward
                if inward is not None and inward in ready:
                    self._hear(inward)
                now = time.monotonic()
                if self._config.listens and now - pinged >= _PING_S:
                    pinged = now
                    self._say([CLOCK, _PING.pack(time.time_ns())])
                if now - pulsed >= _PULSE_S:
                    pulsed = now
                    self._say([PULSE])
                if now - looked >= _LOOK_S:
                    looked = now
                    self._look_for_revocations()
                    self._knock_again(now)
                self._doors.follow(self._wanted & frozenset(self._config.imports))
        except Exception as failure:  # the gateway must not continue without its link
            self._inbox.fail(failure)
        finally:
            self._close_all()

    def _drain_outbox(self, ready: set[Any]) -> None:
        if self._wake in ready:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)
        while self._outbox:
            self._say(self._outbox.popleft())

    def _say(self, frames: list[bytes]) -> None:
        door = self._doors.outward
        if door is not None:
            door.send_multipart(frames, zmq.NOBLOCK)

    def _hear(self, socket: zmq.Socket[Any]) -> None:
        for _ in range(LINK_QUEUE):
            try:
                parts = socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            # Copied only after the size check. Until then these are views of at most the socket's size limit.
            try:
                self._take(parts)
            except MessageError as error:
                self._log.refuse(f"message: {error}")

    def _take(self, parts: list[zmq.Frame]) -> None:
        name = parts[0].bytes if len(parts[0]) <= 64 else b"?"
        self.heard_mono_ns = time.monotonic_ns()
        if name == CLOCK:
            self._clock(parts)
            return
        if name == PULSE and len(parts) == 1:
            return
        # A subscription is a prefix, so a received topic may be longer than the subscribed one.
        topic = name.decode("utf-8", "replace")
        if topic not in self._config.imports:
            raise MessageError(f"expected an imported topic, got {topic!r:.80}")
        typename = topic_row(topic).type
        limit = MOST_BYTES if typename in _LARGE else _SMALL_BYTES
        if len(parts) != 3 or len(parts[2]) > limit:
            sizes = [len(part) for part in parts[:8]]
            raise MessageError(
                f"expected three frames and at most {limit} bytes of {typename} on {topic}, got {sizes}"
            )
        meta, cdr = unpack(topic, [part.bytes for part in parts])
        decode(typename, cdr)  # refuses messages that cannot be decoded
        self._inbox.put(Inbound(topic, Relayed(on_our_clock(meta, time.time_ns(), time.monotonic_ns()), cdr)))

    def _clock(self, parts: list[zmq.Frame]) -> None:
        heard_ns = time.time_ns()
        body = parts[1].bytes if len(parts) == 2 and len(parts[1]) <= _PONG.size else b""
        if not self._config.listens and len(body) == _PING.size:
            (asked_ns,) = _PING.unpack(body)
            self._say([CLOCK, _PONG.pack(asked_ns, heard_ns, time.time_ns())])
        elif self._config.listens and len(body) == _PONG.size:
            asked_ns, received_ns, answered_ns = _PONG.unpack(body)
            newest = Exchange(asked_ns, received_ns, answered_ns, heard_ns)
            if not 0.0 <= newest.round_trip_s < 60.0:
                raise MessageError(
                    f"expected a clock exchange with a valid round trip, got {newest.round_trip_s:g} s"
                )
            peer = str(
                parts[1].get("User-Id")
            )  # the name that the doorkeeper found for the key; the drive door is never open without keys
            best = self._offsets.setdefault(peer, OffsetFilter()).add(newest)
            self._inbox.put(Offset(peer, best, newest))
        else:
            raise MessageError(f"expected a clock exchange, got {[len(part) for part in parts[:8]]} bytes")

    def _look_for_revocations(self) -> None:
        """Disconnect revoked keys. ZeroMQ authenticates only at the handshake, so the door is closed and reopened."""
        if self._keeper is None:
            return
        for right, gone in self._keeper.revoked().items():
            self._log.say(
                f"{', '.join(gone)} may no longer {right}; all connections of that door must authenticate again"
            )
            self._reopen(right)

    def _knock_again(self, now: float) -> None:
        """Reconnect after a refusal. ZeroMQ itself does not retry, but the key may be allowed later."""
        for right, since in list(self._locked_out.items()):
            if now - since >= _KNOCK_S:
                del self._locked_out[right]
                self._reopen(right)

    def _reopen(self, right: str) -> None:
        self._doors.close(right)
        try:
            self._doors.open(right)
        except (OSError, zmq.ZMQError) as error:
            if not has_run_out(error.errno):
                raise
            self._log.say(f"the {right} door cannot be opened now: {error.strerror}")
            self._locked_out[right] = time.monotonic()

    def _note(self, event: Handshake) -> None:
        if event.refusal:
            self._log.refuse(event.refusal)
        if not self._config.listens:
            if event.refusal:
                self._refusals[event.right] = event.refusal, time.monotonic()
            elif not event.ended:
                self._refusals.pop(event.right, None)
            # No reconnection after a successful handshake, because it would end the connection.
            if event.refusal or event.ended:
                self._locked_out.setdefault(event.right, time.monotonic())
            else:
                self._locked_out.pop(event.right, None)
        elif event.ended:
            self._log.say(f"the {event.right} door: a connection ended")
        elif not event.refusal:
            how = "without a key" if self._config.keys is None else "with an allowed key"
            self._log.say(f"the {event.right} door: a connection {how} started")


def on_our_clock(meta: Meta, real_ns: int, mono_ns: int) -> Meta:
    """Convert the publish time of a message to the local monotonic clock, using its age in real time. It is never in the future.

    The monotonic clocks of two hosts are unrelated. The real-time clocks are comparable because the safety node checks their measured
    offset.
    """
    age_ns = min(max(0, real_ns - meta.publish_real_ns), mono_ns, 3600 * NS_PER_S)
    return Meta(mono_ns - age_ns, meta.publish_real_ns, meta.sequence, meta.type_prefix, meta.instance_id)
