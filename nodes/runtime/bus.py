"""Publish and subscribe between the processes of one host, with one XPUB socket per topic and no broker.

Of a topic that any process may send, such as a request to stop the car, the receivers bind the sockets and the senders connect. A
sender then needs no separate endpoint, lock or file.

This module is the only one that uses ZeroMQ inside a host. Receivers of a ``latest`` topic drain it to the newest message. A small
high-water mark alone would leave stale frames, and CONFLATE keeps only the last frame of a multipart message. Other topics keep
their queue, and gaps in the sequence are counted. A bus belongs to the thread that made it. That thread must call `Bus.wait` or
`Bus.receive` regularly, because ZeroMQ renews a subscription to a restarted publisher only when the socket is used.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import zmq

from nodes.runtime.clock import NS_PER_S, Clock, SystemClock
from nodes.runtime.descriptors import require_free
from nodes.runtime.errors import BusError, MessageError, TakenError
from nodes.runtime.image_parts import IMAGE_TYPE, PartedInfo, join_image, split_image, with_parts
from nodes.runtime.locks import HeldError, hold
from nodes.runtime.messages import MAX_SEQUENCE_LENGTH, decode, encode, type_hash_prefix, type_name
from nodes.runtime.paths import bus_folder, lock_path, socket_path
from nodes.runtime.topics import STATUS_PREFIX, Topic
from nodes.runtime.topics import topic as topic_row
from nodes.runtime.wire import MessageInfo, Meta, Relayed, pack_meta, unpack_parts

_SEND_QUEUE = 16
# Deep enough for a reader that stalls for seconds: a full pipe would block newer messages, and the newest would not be received.
_LATEST_QUEUE = 64
# Limit of messages per call, so that a publisher that is faster than its reader cannot block the reader for ever.
_DRAIN_LIMIT = 1000
_FAREWELL_MS = 100
# Plain integers: every operation on pyzmq's enumerations costs a microsecond, and there are several per message.
_POLLIN, _NOBLOCK = int(zmq.POLLIN), int(zmq.NOBLOCK)
_EVENTS, _RCVMORE = int(zmq.EVENTS), int(zmq.RCVMORE)
_NOBLOCK_MORE = _NOBLOCK | int(zmq.SNDMORE)


@dataclass(frozen=True)
class Received:
    """One message off the wire, not decoded yet.

    Attributes:
        topic: Name of the topic.
        info: Transport data, including the bytes.
    """

    topic: str
    info: MessageInfo

    def message(self) -> Any:
        """Decode the message."""
        if isinstance(self.info, PartedInfo):
            return join_image(*self.info.parts)
        return decode(topic_row(self.topic).type, self.info.raw)


@dataclass
class Counts:
    """Counts of received, dropped, lost and refused messages of one subscription."""

    received: int = 0
    dropped: int = 0  # skipped for a newer one, on a topic that keeps only the newest
    lost: int = 0  # published but not received, because a queue was full
    refused: int = 0  # wrong format, or another version of the type


class Publisher:
    """Publishes one topic. Each run folder allows as many publishers of a topic as the topic has senders, usually one.

    Any number of processes may publish a topic whose receivers bind.
    """

    def __init__(
        self, context: zmq.Context[Any], run_dir: Path, topic: Topic, instance_id: int, clock: Clock
    ) -> None:
        self.topic = topic
        self._clock = clock
        self._instance_id = instance_id
        self._prefix = type_hash_prefix(topic.type)
        self._name = topic.name.encode()
        self._sequence = 0
        self._subscribers = 0
        self._lock: TextIO | None = None
        self._is_status = topic.name.startswith(STATUS_PREFIX)
        self._socket = context.socket(zmq.XPUB)
        self._socket.linger = 0
        self._socket.sndhwm = _SEND_QUEUE
        # XPUB_VERBOSER reports every subscriber that joins or leaves. The readiness barrier counts them.
        self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        if topic.receivers:
            # Without this option, a receiver that restarts would get the messages of the meantime, and would be counted twice.
            self._socket.setsockopt(zmq.IMMEDIATE, 1)
            _connect(self._socket, run_dir, topic)
        else:
            self._lock = _bind(self._socket, run_dir, topic)

    def publish(self, message: Any) -> None:
        """Send a message, or CDR bytes of the topic's type, without blocking."""
        if isinstance(message, Relayed):
            self._send_frames(message.meta, message.cdr)
            return
        if isinstance(message, bytes | memoryview):
            cdr: bytes | memoryview = message
        elif type_name(message) != self.topic.type:
            raise MessageError(f"expected {self.topic.type} on {self.topic.name}, got {type_name(message)}")
        elif self.topic.type == IMAGE_TYPE and (parts := split_image(message)):
            self._send(*parts)
            return
        else:
            cdr = encode(message)
        self._send(cdr)

    def _send(self, *cdr: bytes | memoryview) -> None:
        now = self._clock.now()
        meta = Meta(now.mono_ns, now.real_ns, self._sequence, self._prefix, self._instance_id)
        self._sequence += 1
        self._send_frames(meta, *cdr)

    def _send_frames(self, meta: Meta, *cdr: bytes | memoryview) -> None:
        send = self._socket.send
        send(self._name, _NOBLOCK_MORE)
        send(pack_meta(meta), _NOBLOCK_MORE)
        for part in cdr[:-1]:
            send(part, _NOBLOCK_MORE)
        send(cdr[-1], _NOBLOCK)
        if self._is_status and self._lock is not None:
            # The file's time keeps the age of the last status readable when this process hangs. A disk may refuse it.
            with contextlib.suppress(OSError):
                os.utime(self._lock.fileno())

    def subscribers(self) -> int:
        """Number of connected subscribers."""
        while self._socket.poll(0, zmq.POLLIN):
            event = self._socket.recv(zmq.NOBLOCK)
            if event == b"\x01" + self._name:
                self._subscribers += 1
            elif event == b"\x00" + self._name:
                self._subscribers = max(0, self._subscribers - 1)
        return self._subscribers

    def close(self, linger_ms: int) -> None:
        """Close the socket. The endpoint stays locked until `unlock`."""
        self._socket.close(linger=linger_ms)

    def unlock(self) -> None:
        """Release the endpoint. Call it after the context is destroyed, because the socket closes in another thread."""
        if self._lock is not None:
            self._lock.close()


@dataclass
class _Subscription:
    topic: Topic
    socket: zmq.Socket[Any]
    take_all: bool
    limit: int
    lock: TextIO | None = None
    counts: Counts = field(default_factory=Counts)
    instance_id: int | None = None
    sequence: int = 0
    last_refusal: str = ""


class Bus:
    """The publishers and subscriptions of one process.

    Args:
        run_dir: Folder of the run. Processes with the same folder share the bus.
        clock: Clock for publish and receive times.
    """

    def __init__(self, run_dir: Path, clock: Clock | None = None) -> None:
        self._run_dir = Path(run_dir)
        self._clock = clock or SystemClock()
        require_free()
        self._context: zmq.Context[Any] = zmq.Context()
        self._poller = zmq.Poller()
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: dict[str, _Subscription] = {}
        self._readable: set[Any] | None = None  # result of the last `wait`; None if `receive` has used it
        self.instance_id = secrets.randbits(64)

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def publisher(self, topic: str) -> Publisher:
        """Return the publisher of a topic, which is opened on first use."""
        if topic not in self._publishers:
            row = topic_row(topic)
            self._publishers[topic] = Publisher(
                self._context, self._run_dir, row, self.instance_id, self._clock
            )
        return self._publishers[topic]

    def publish(self, topic: str, message: Any) -> None:
        """Send a message, or CDR bytes of the topic's type."""
        self.publisher(topic).publish(message)

    def subscribe(self, topic: str, queue: int | None = None) -> None:
        """Subscribe to a topic, even if its publisher does not exist yet.

        Args:
            topic: Name from the topic table.
            queue: Keep every message, up to this number, even of a ``latest`` topic (for the recorder).
        """
        if topic in self._subscriptions:
            return
        row = topic_row(topic)
        take_all = queue is not None or not row.latest
        limit = queue or row.queue
        socket = self._context.socket(zmq.SUB)
        socket.linger = 0
        socket.rcvhwm = limit if take_all else _LATEST_QUEUE
        socket.setsockopt(zmq.MAXMSGSIZE, 2 * MAX_SEQUENCE_LENGTH)
        socket.subscribe(row.name.encode())
        lock = None
        if row.receivers:
            lock = _bind(socket, self._run_dir, row)
        else:
            _connect(socket, self._run_dir, row)
        self._poller.register(socket, zmq.POLLIN)
        self._subscriptions[topic] = _Subscription(row, socket, take_all, limit, lock)

    def watch(self, file_descriptor: int) -> None:
        """Make `wait` also return when a file descriptor is readable."""
        self._poller.register(file_descriptor, zmq.POLLIN)

    def wait(self, timeout_s: float) -> set[int]:
        """Sleep until a message arrives or the timeout ends. Returns the watched file descriptors that are readable."""
        # ZeroMQ counts in milliseconds. The remaining fraction is slept, so that a tick is on time without spinning.
        ready = self._poller.poll(max(0, int(timeout_s * 1e3)))
        if not ready and 0.0 < timeout_s < 1e-3:
            time.sleep(timeout_s)
        found = {entry for entry, _ in ready}
        self._readable = found
        return {entry for entry in found if isinstance(entry, int)}

    def receive(self) -> list[Received]:
        """Return the messages that have arrived, in order of publication; of ``latest`` topics only the newest."""
        batch: list[Received] = []
        readable, self._readable = self._readable, None
        for subscription in self._subscriptions.values():
            if readable is None or subscription.socket in readable:
                batch += self._receive_one(subscription)
        if len(batch) > 1:
            batch.sort(key=lambda received: received.info.publish_mono_ns)
        return batch

    def _receive_one(self, subscription: _Subscription) -> list[Received]:
        kept: list[Received] = []
        for _ in range(subscription.limit if subscription.take_all else _DRAIN_LIMIT):
            # Polling first costs a tenth of the exception that an empty socket raises.
            if not int(subscription.socket.get(_EVENTS)) & _POLLIN:
                break
            frames = _frames(subscription.socket)
            try:
                meta, parts = unpack_parts(subscription.topic.name, frames)
            except MessageError as error:
                subscription.counts.refused += 1
                subscription.last_refusal = str(error)
                continue
            received = Received(subscription.topic.name, self._info(subscription, meta, parts))
            if kept and not subscription.take_all:
                subscription.counts.dropped += 1
                kept[0] = received
            else:
                kept.append(received)
        return kept

    def _info(self, subscription: _Subscription, meta: Meta, parts: Sequence[bytes]) -> MessageInfo:
        same_publisher = meta.instance_id == subscription.instance_id
        lost = max(0, meta.sequence - subscription.sequence - 1) if same_publisher else 0
        subscription.instance_id, subscription.sequence = meta.instance_id, meta.sequence
        subscription.counts.received += 1
        subscription.counts.lost += lost
        now = self._clock.now()
        in_two = len(parts) == 2 and subscription.topic.type == IMAGE_TYPE
        raw = b"" if in_two else parts[0] if len(parts) == 1 else b"".join(parts)
        info = MessageInfo(
            # All processes of a host read the same clock, so a publication in the future is an error. It must not stay fresh for ever.
            publish_mono_ns=min(meta.publish_mono_ns, now.mono_ns),
            receive_mono_ns=now.mono_ns,
            sequence=meta.sequence,
            raw=raw,
            publish_real_ns=meta.publish_real_ns,
            receive_real_ns=now.real_ns,
            instance_id=meta.instance_id,
            lost=lost,
        )
        return with_parts(info, (parts[0], parts[1])) if in_two else info

    def refuse(self, topic: str, reason: str) -> None:
        """Count a message whose bytes could not be decoded."""
        subscription = self._subscriptions[topic]
        subscription.counts.refused += 1
        subscription.last_refusal = reason

    def refusals(self) -> dict[str, str]:
        """Reason of the last refused message, by topic."""
        return {name: s.last_refusal for name, s in self._subscriptions.items() if s.last_refusal}

    def counts(self) -> dict[str, Counts]:
        """Message counts of every subscription, by topic."""
        return {name: subscription.counts for name, subscription in self._subscriptions.items()}

    def subscribers(self, topic: str) -> int:
        """Number of subscribers connected to a topic that this process publishes."""
        return self.publisher(topic).subscribers()

    def wait_for_subscribers(self, topics: Iterable[str], timeout_s: float) -> None:
        """Wait until every topic has a subscriber. ZeroMQ drops messages that are sent before."""
        deadline = time.monotonic() + timeout_s
        waiting = list(topics)
        while waiting := [name for name in waiting if not self.subscribers(name)]:
            if time.monotonic() > deadline:
                raise BusError(
                    f"expected a subscriber of {', '.join(waiting)} within {timeout_s:g} s, got none; is the receiving node running "
                    f"with the same --folder ({self._run_dir})?"
                )
            time.sleep(0.005)

    def close(self, farewell: bool = False) -> None:
        """Close all sockets and release the endpoints.

        Args:
            farewell: Wait up to 100 ms for messages that were just sent.
        """
        for subscription in self._subscriptions.values():
            self._poller.unregister(subscription.socket)
            subscription.socket.close(linger=0)
        for publisher in self._publishers.values():
            publisher.close(_FAREWELL_MS if farewell else 0)
        self._context.term()
        for publisher in self._publishers.values():
            publisher.unlock()
        for subscription in self._subscriptions.values():
            if subscription.lock is not None:
                subscription.lock.close()
        self._publishers.clear()
        self._subscriptions.clear()


def _frames(socket: zmq.Socket[Any]) -> list[bytes]:
    """Receive all frames of the waiting message."""
    frames = [socket.recv(_NOBLOCK)]
    while socket.get(_RCVMORE):
        frames.append(socket.recv(_NOBLOCK))
    return frames


def age_s(info: MessageInfo, mono_ns: int) -> float:
    """Age of a message since its publication [s]."""
    return (mono_ns - info.publish_mono_ns) / NS_PER_S


def socket_paths(run_dir: Path, topic: Topic) -> list[Path]:
    """Paths of the Unix sockets of a topic, one for each process that may send it, or receive it if its receivers bind."""
    first = socket_path(run_dir, topic.name)
    count = topic.receivers or topic.senders
    return [first, *(first.with_name(f"{first.name}.{number}") for number in range(2, count + 1))]


def _connect(socket: zmq.Socket[Any], run_dir: Path, topic: Topic) -> None:
    """Connect to all endpoints of a topic, whether a process has bound them yet or not. An error closes the socket.

    An open socket would keep the bus from closing for ever.
    """
    try:
        # A process that binds later must be found within its first period, without the growing default delay.
        socket.setsockopt(zmq.RECONNECT_IVL, 20)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 100)
        for path in socket_paths(run_dir, topic):
            socket.connect(f"ipc://{path}")
    except BaseException:
        socket.close()
        raise


def _bind(socket: zmq.Socket[Any], run_dir: Path, topic: Topic) -> TextIO:
    """Bind a socket to a free endpoint of a topic and return the lock of the endpoint. An error closes the socket.

    Without the lock, a second bind to an ipc path succeeds silently and takes the first one's peers.
    """
    owners = []
    try:
        for path in socket_paths(run_dir, topic):
            try:
                lock = hold(lock_path(path))
            except HeldError as error:
                owners.append(error.owner)
                continue
            try:
                socket.bind(f"ipc://{path}")
            except zmq.ZMQError as error:
                lock.close()
                raise BusError(
                    f"cannot open {topic.name} at {path}: {error.strerror}; check the run folder"
                ) from error
            return lock
        raise TakenError(_taken(topic, run_dir, owners))
    except BaseException:
        socket.close()
        raise


def _taken(topic: Topic, run_dir: Path, owners: list[str]) -> str:
    if topic.receivers:
        return (
            f"expected at most {topic.receivers} processes that receive {topic.name} in {run_dir}, got another one beside process "
            f"{', '.join(owners)}; stop one of them"
        )
    taken = f"{topic.name} is already published in {run_dir} by"
    nodes = [name for owner in owners for name in _nodes_of(run_dir, owner)]
    if nodes and not topic.name.startswith(STATUS_PREFIX):
        return (
            f"{taken} the node {', '.join(nodes)} (process {', '.join(owners)}). Leave the topic out here (bag play: --topics, --remap), "
            f"start the launch without that node (--set {nodes[0]}.if=false), or use another --folder"
        )
    if topic.name.startswith(STATUS_PREFIX):
        return (
            f"expected one node {topic.name.removeprefix(STATUS_PREFIX)} in {run_dir}, got another one beside process {', '.join(owners)}; "
            "end that one, or use another --folder"
        )
    return (
        f"{taken} process {', '.join(owners)}: another launch uses the same endpoints. "
        "Stop it, or use another --folder"
    )


def _nodes_of(run_dir: Path, process: str) -> list[str]:
    """Names of the nodes whose status a process publishes."""
    prefix = socket_path(run_dir, STATUS_PREFIX + "x").name[:-1]
    locks = sorted(bus_folder(run_dir).glob(f"{prefix}*.lock"))
    return [
        lock.stem.removeprefix(prefix)
        for lock in locks
        if lock.read_text(encoding="ascii", errors="replace").strip() == process
    ]
