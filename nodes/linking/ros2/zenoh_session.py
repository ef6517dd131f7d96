"""The Zenoh end of the ROS 2 node: one session that speaks as ``rmw_zenoh_cpp`` does. The only module that imports ``zenoh``.

QoS as there: a full queue drops samples, reliable or not; the newest are kept. Durability is volatile.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence

import zenoh

from nodes.linking.ros2.publishers import Publishers
from nodes.linking.ros2.rmw_zenoh import (
    PUBLISHER,
    SUBSCRIPTION,
    Attachment,
    endpoint_token,
    gid_of,
    node_token,
    parse_token,
    tokens_of,
    topic_key,
)
from nodes.linking.ros2.routes import Endpoint, dds_name
from nodes.linking.ros2.samples import Heard
from nodes.linking.ros2.zenoh_settings import ZenohSettings, require_local_router, session_config
from nodes.runtime.errors import BusError, MessageError
from nodes.runtime.inbox import Inbox, ReaderThread
from nodes.runtime.messages import type_hash

NODE_NAME = "advnerf"
_FIRST_NUMBER = 10  # of the tokens of publishers and subscriptions
# A flood may not keep the interpreter busy: after a full batch the reader rests, and Zenoh keeps the newest samples.
_REST_S = 0.002
_WATCHED_DEPTH = 16
_LOOK_S = 1.0


class Session:
    """One Zenoh session, which reads each topic in a separate thread.

    Args:
        domain_id: ``ROS_DOMAIN_ID``.
        interface: Network interface.
        local: Whether that is the loopback of this computer.
        settings: Ways to find ROS programs.
        sends: Topics to write.
        takes: Topics to read.
        inbox: Receives batches of samples.
        watched: Numbers of the sent topics beside which no other publisher may exist.
    """

    def __init__(
        self,
        domain_id: int,
        interface: str,
        local: bool,
        settings: ZenohSettings,
        sends: Sequence[Endpoint],
        takes: Sequence[Endpoint],
        inbox: Inbox[list[Heard]],
        watched: Sequence[int] = (),
    ) -> None:
        self._domain_id, self._local, self._settings = domain_id, local, settings
        self._looked_s, self._alone = -_LOOK_S, ""
        self._session = _open(settings, interface, local)
        self._tokens = [self._declare(node_token(domain_id, self._identity, NODE_NAME))]
        self._writers = [self._writer(_FIRST_NUMBER + k, each) for k, each in enumerate(sends)]
        self._watched = {
            k: (self._subscribe(sends[k], _WATCHED_DEPTH), self._writers[k].graph) for k in watched
        }
        first = _FIRST_NUMBER + len(sends)
        self._readers = [self._reader(k, first + k, each) for k, each in enumerate(takes)]
        self._threads = [ReaderThread(reader.read, inbox, "zenoh") for reader in self._readers]
        for thread in self._threads:
            thread.start()

    def write(self, number: int, cdr: bytes) -> bool:
        """Write CDR bytes. Zenoh neither blocks nor reports a full queue."""
        self._writers[number].write(cdr)
        return True

    def present(self, number: int) -> tuple[str, ...]:
        """Identities of the publishers of a reader's topic."""
        return self._readers[number].graph.present()

    def mismatch(self, number: int) -> str:
        """Why publishers of a reader's topic are not heard; empty if there are none of these."""
        self._look()
        graph = self._readers[number].graph
        return graph.mismatch() or ("" if graph.present() else self._alone)

    def rivals(self, number: int) -> tuple[str, ...]:
        """Identities of the other publishers of a watched writer's topic."""
        subscriber, graph = self._watched[number]
        for _ in range(_WATCHED_DEPTH):
            if (sample := subscriber.try_recv()) is None:
                break
            graph.heard(_attachment(sample).gid.hex())
        return graph.all()

    def readers_of(self, number: int) -> int:
        """Number of subscribers of a writer's topic."""
        self._look()
        return self._writers[number].graph.subscribers

    def close(self) -> None:
        """Leave the network."""
        for thread in self._threads:
            thread.stop(0.0)  # it waits for a sample until the session ends
        for token in self._tokens:
            token.undeclare()
        self._session.close()
        for thread in self._threads:
            thread.stop()

    @property
    def _identity(self) -> str:
        return str(self._session.info.zid())

    def _declare(self, token: str) -> zenoh.LivelinessToken:
        return self._session.liveliness().declare_token(token)

    def _announce(self, number: int, kind: str, endpoint: Endpoint) -> tuple[str, _Graph]:
        token = endpoint_token(self._domain_id, self._identity, number, kind, NODE_NAME, endpoint)
        self._tokens.append(self._declare(token))
        return token, _Graph(self._session, self._domain_id, endpoint, token)

    def _subscribe(self, endpoint: Endpoint, depth: int) -> zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]:
        newest: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(depth)
        key = topic_key(self._domain_id, endpoint)
        return self._session.declare_subscriber(key, newest, allowed_origin=zenoh.Locality.REMOTE)

    def _writer(self, number: int, endpoint: Endpoint) -> _Writer:
        publisher = self._session.declare_publisher(
            topic_key(self._domain_id, endpoint),
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE if endpoint.reliable else zenoh.Reliability.BEST_EFFORT,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        return _Writer(publisher, *self._announce(number, PUBLISHER, endpoint))

    def _reader(self, reader: int, number: int, endpoint: Endpoint) -> _Reader:
        _, graph = self._announce(number, SUBSCRIPTION, endpoint)
        return _Reader(reader, endpoint, self._subscribe(endpoint, endpoint.depth), graph)

    def _look(self) -> None:
        """Look at the router, which may come and go at any time."""
        if (now_s := time.monotonic()) - self._looked_s < _LOOK_S:
            return
        self._looked_s, self._alone = now_s, ""
        if self._local:
            require_local_router(self._settings)
        info = self._session.info
        if self._settings.connects and not [*info.routers_zid(), *info.peers_zid()]:
            self._alone = (
                f"no Zenoh router at {', '.join(self._settings.connects)} yet; start one (ros2 run rmw_zenoh_cpp rmw_zenohd),"
                " or set zenoh.router: true"
            )


class _Graph:
    """The programs that announce a topic by liveliness tokens. Zenoh's threads write, ours read."""

    def __init__(self, session: zenoh.Session, domain_id: int, endpoint: Endpoint, own: str) -> None:
        self._lock, self._publishers, self._own = threading.Lock(), Publishers(endpoint, own), own
        self._type = dds_name(endpoint.typename), type_hash(endpoint.typename)
        self._subscriptions: set[str] = set()
        tokens = tokens_of(domain_id, endpoint.ros)
        self._subscriber = session.liveliness().declare_subscriber(tokens, self._changed, history=True)

    @property
    def subscribers(self) -> int:
        """Number of subscriptions other than our own."""
        with self._lock:
            return len(self._subscriptions)

    def heard(self, gid: str) -> str:
        """Identity of the publisher of a sample that has just arrived."""
        with self._lock:
            return self._publishers.heard(gid, time.monotonic_ns())

    def present(self) -> tuple[str, ...]:
        """Identities of the publishers; none if none is announced."""
        with self._lock:
            return self._publishers.present(time.monotonic_ns())

    def all(self) -> tuple[str, ...]:
        """Identities of the publishers, also if none is announced."""
        with self._lock:
            return self._publishers.all(time.monotonic_ns())

    def mismatch(self) -> str:
        """Why publishers of this name are not heard; empty if there are none of these."""
        with self._lock:
            return self._publishers.mismatch()

    def _changed(self, sample: zenoh.Sample) -> None:
        token = parse_token(str(sample.key_expr))
        if token is None:
            return
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._publishers.withdraw(token.key)
                self._subscriptions.discard(token.key)
                return
            self._publishers.announce(token)
            reads = token.kind == SUBSCRIPTION and (token.typename, token.type_hash) == self._type
            if reads and token.key != self._own:
                self._subscriptions.add(token.key)


class _Writer:
    """One publisher."""

    def __init__(self, publisher: zenoh.Publisher, token: str, graph: _Graph) -> None:
        self._publisher, self.graph = publisher, graph
        self._gid, self._sequence = gid_of(token), 0

    def write(self, cdr: bytes) -> None:
        """Write a sample."""
        self._sequence += 1
        attachment = Attachment(self._sequence, time.time_ns(), self._gid)
        try:
            self._publisher.put(cdr, attachment=attachment.encode())
        except zenoh.ZError as error:
            raise BusError(f"cannot write to Zenoh: {error}") from error


class _Reader:
    """One subscription."""

    def __init__(self, number: int, endpoint: Endpoint, subscriber: zenoh.Subscriber, graph: _Graph) -> None:
        self._number, self._depth, self._hash = number, endpoint.depth, type_hash(endpoint.typename)
        self._subscriber, self.graph = subscriber, graph

    def read(self) -> list[Heard] | None:
        """Wait for a sample and take it, with those behind it."""
        samples = [self._subscriber.recv()]
        while len(samples) < self._depth and (sample := self._subscriber.try_recv()) is not None:
            samples.append(sample)
        if len(samples) >= self._depth:
            time.sleep(_REST_S)
        mono_ns, real_ns = time.monotonic_ns(), time.time_ns()
        return [self._heard(sample, mono_ns, real_ns) for sample in samples]

    def _heard(self, sample: zenoh.Sample, mono_ns: int, real_ns: int) -> Heard:
        attachment = _attachment(sample)
        writer = self.graph.heard(attachment.gid.hex())
        present = self.graph.present()
        # The hash of the type is a part of the key, so it is ours.
        return Heard(
            self._number,
            sample.payload.to_bytes(),
            writer,
            self._hash,
            present,
            attachment.source_real_ns,
            mono_ns,
            real_ns,
        )


def _attachment(sample: zenoh.Sample) -> Attachment:
    """Attachment of a sample; without identity if it has none that can be read."""
    try:
        return Attachment.decode(b"" if sample.attachment is None else sample.attachment.to_bytes())
    except MessageError:
        return Attachment(0, 0, b"")


def _open(settings: ZenohSettings, interface: str, local: bool) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in session_config(settings, interface, local).items():
        config.insert_json5(key, json.dumps(value))
    if local:
        require_local_router(settings)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(
            f"cannot open a Zenoh session that listens on {', '.join(settings.listens)}: {error}; another router may run on"
            " this computer (zenoh.router: false uses it)"
        ) from error
