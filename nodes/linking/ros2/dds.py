"""The DDS end of the ROS 2 node: one participant with its readers and writers. With `idl` the only module that imports ``cyclonedds``.

On the loopback interface the participant hears this computer alone. Cyclone DDS sends on the chosen interface, but its sockets
receive from every one, so they are bound to the loopback device as well.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from cyclonedds.core import DDSException, ReadCondition, WaitSet
from cyclonedds.core import InstanceState as Instances
from cyclonedds.core import SampleState as Samples
from cyclonedds.core import ViewState as Views
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from nodes.linking.ros2.idl import bytes_type, dds_topic
from nodes.linking.ros2.routes import Endpoint
from nodes.linking.ros2.samples import Heard
from nodes.linking.sockets import MOST_BYTES
from nodes.runtime.errors import BusError, SecurityError
from nodes.runtime.inbox import Inbox, ReaderThread
from nodes.runtime.messages import type_hash

_WAIT_MS = 100
_ATTEMPTS = 10
# A flood may not keep the interpreter busy: after a full batch the reader rests, and the middleware keeps the newest samples.
_REST_S = 0.002
_TYPE_HASH = re.compile(r"typehash=(RIHS01_[0-9a-f]{64});")
_ANY = Views.Any | Instances.Alive | Samples.NotRead
# Type information of Fast DDS (1.15) is refused by Cyclone DDS, and then nothing matches. Types are compared by name and ROS type hash.
_CONFIG = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces>{local_general}</General>
<Discovery>{local_discovery}</Discovery>
<Internal><MaxSampleSize>{most_bytes}B</MaxSampleSize></Internal>
<Compatibility><IgnoreTypeInformation>1.15,1.16</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>"""
# Loopback has no multicast on most computers: participants are looked for one by one, again and again, because ROS programs that start
# later may announce themselves by multicast only. Large datagrams save the fragments.
_LOCAL_GENERAL = "<AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize>"
_LOCAL_DISCOVERY = (
    "<SPDPInterval>500ms</SPDPInterval><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    '<Peers><Peer Address="localhost"/></Peers>'
)


class Participant:
    """One DDS participant, which reads in a separate thread.

    Args:
        domain_id: DDS domain (``ROS_DOMAIN_ID``).
        interface: Network interface.
        local: Whether that is the loopback of this computer.
        sends: Topics to write.
        takes: Topics to read.
        inbox: Receives batches of samples.
        watched: Numbers of the writers beside which no other publisher may exist.
    """

    def __init__(
        self,
        domain_id: int,
        interface: str,
        local: bool,
        sends: Sequence[Endpoint],
        takes: Sequence[Endpoint],
        inbox: Inbox[list[Heard]],
        watched: Sequence[int] = (),
    ) -> None:
        before = _udp_sockets()
        try:
            self._domain = Domain(domain_id, domain_config(interface, local))
            self._participant = DomainParticipant(domain_id, qos=Qos(Policy.Userdata(b"enclave=/;")))
            if local:  # before there is a reader that a packet from another host could reach
                _bind_to_device(_udp_sockets() - before, interface)
            self._writers = [_writer(self._participant, each) for each in sends]
            self._readers = [_DdsReader(number, self._participant, each) for number, each in enumerate(takes)]
            self._rivals = {
                number: _DdsReader(number, self._participant, _any_qos(sends[number])) for number in watched
            }
        except DDSException as error:
            raise BusError(
                f"cannot open DDS domain {domain_id} on {interface}: {error.msg}; see the lines above"
            ) from error
        self._waitset = WaitSet(self._participant)
        for reader in self._readers:
            self._waitset.attach(reader.condition)
        self._thread = ReaderThread(self._read, inbox, "dds")
        self._thread.start()

    def write(self, number: int, cdr: bytes) -> bool:
        """Write CDR bytes without blocking. Returns False if the middleware's queue is full."""
        writer = self._writers[number]
        try:
            writer.write(writer.data_type(cdr))
        except DDSException as error:
            if error.code == DDSException.DDS_RETCODE_TIMEOUT:
                return False
            raise BusError(f"cannot write to DDS: {error.msg}") from error
        return True

    def present(self, number: int) -> tuple[str, ...]:
        """Identities of the publishers of a reader's topic."""
        return self._readers[number].present()

    def mismatch(self, number: int) -> str:
        """Why publishers of a reader's topic are not heard; empty if there are none of these."""
        return self._readers[number].mismatch()

    def rivals(self, number: int) -> tuple[str, ...]:
        """Identities of the other publishers of a watched writer's topic."""
        return self._rivals[number].present()

    def readers_of(self, number: int) -> int:
        """Number of subscribers of a writer's topic."""
        return len(self._writers[number].get_matched_subscriptions())

    def close(self) -> None:
        """Leave the domain."""
        self._thread.stop()
        # An entity leaves the domain with its last reference.
        del self._waitset, self._readers, self._rivals, self._writers, self._participant, self._domain

    def _read(self) -> list[Heard] | None:
        self._waitset.wait(duration(milliseconds=_WAIT_MS))
        heard: list[Heard] = []
        full = False
        for reader in self._readers:
            taken = reader.take()
            full |= len(taken) >= reader.depth
            heard += taken
        if full:
            time.sleep(_REST_S)
        return heard or None


class _DdsReader:
    """One DDS reader and the identities of its publishers."""

    def __init__(self, number: int, participant: Any, endpoint: Endpoint) -> None:
        self._number, self._endpoint, self.depth = number, endpoint, endpoint.depth
        self._reader = DataReader(participant, _topic(participant, endpoint), qos=_qos(endpoint))
        self.condition = ReadCondition(self._reader, _ANY)
        self._known: dict[int, tuple[str, str]] = {}

    def take(self) -> list[Heard]:
        """Take what has arrived."""
        samples = self._reader.take(self.depth)
        if not samples:
            return []
        present, mono_ns, real_ns = self.present(), time.monotonic_ns(), time.time_ns()
        return [
            Heard(
                self._number,
                sample.cdr,
                *self._identity(sample.sample_info.publication_handle),
                present,
                sample.sample_info.source_timestamp,
                mono_ns,
                real_ns,
            )
            for sample in samples
            if sample.sample_info.valid_data
        ]

    def present(self) -> tuple[str, ...]:
        """Identities of the publishers, in a fixed order."""
        found = {handle: self._identity(handle) for handle in self._handles()}
        self._known = found  # publishers that left are forgotten
        return tuple(sorted(identity for identity, _ in found.values()))

    def mismatch(self) -> str:
        """Why publishers are not heard; empty if there are none of these."""
        status = self._reader.get_requested_incompatible_qos_status()
        if status.total_count and not self._handles():
            asked = "reliable" if self._endpoint.reliable else "best effort"
            return f"a publisher of {self._endpoint.ros} does not offer {asked} delivery; change its QoS or this route's 'reliability'"
        return ""

    def _handles(self) -> list[int]:
        for _ in range(_ATTEMPTS):
            try:
                found = self._reader.get_matched_publications()
            except IndexError:  # another publisher came while the binding counted them
                continue
            return [handle & 0xFFFFFFFFFFFFFFFF for handle in found]
        raise BusError(
            f"cannot count the publishers of {self._endpoint.ros}: they change too fast; look for the program that restarts"
        )

    def _identity(self, handle: int) -> tuple[str, str]:
        """Identity of a publisher, and the ROS hash of its type if it states one."""
        if (known := self._known.get(handle)) is not None:
            return known
        data = self._reader.get_matched_publication_data(handle)
        if data is None:
            return f"handle {handle:x}", ""
        stated = data.qos[Policy.Userdata].data if Policy.Userdata in data.qos else b""
        found = _TYPE_HASH.search(bytes(stated).decode("ascii", "replace"))
        return data.key.hex, found[1] if found else ""


def _any_qos(endpoint: Endpoint) -> Endpoint:
    """A reader that every publisher of the topic matches."""
    return replace(endpoint, reliable=False, depth=1)


def _topic(participant: Any, endpoint: Endpoint) -> Any:
    return Topic(participant, dds_topic(endpoint.ros), bytes_type(endpoint.typename))


def _writer(participant: Any, endpoint: Endpoint) -> Any:
    return DataWriter(participant, _topic(participant, endpoint), qos=_qos(endpoint))


def _qos(endpoint: Endpoint) -> Any:
    # A reliable writer whose slow reader fills the queue returns at once: the node's loop must not wait for a subscriber.
    reliability = Policy.Reliability.Reliable(0) if endpoint.reliable else Policy.Reliability.BestEffort
    return Qos(
        reliability,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(endpoint.depth),
        Policy.IgnoreLocal.Participant,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={type_hash(endpoint.typename)};".encode()),
    )


def domain_config(interface: str, local: bool) -> str:
    """Configuration (XML) of Cyclone DDS on an interface."""
    return _CONFIG.format(
        interface=interface,
        most_bytes=MOST_BYTES,
        local_general=_LOCAL_GENERAL if local else "",
        local_discovery=_LOCAL_DISCOVERY if local else "",
    )


def _udp_sockets() -> set[int]:
    """File descriptors of this process that are IPv4 or IPv6 datagram sockets."""
    found = set()
    for entry in os.listdir("/proc/self/fd"):
        try:
            if not os.readlink(f"/proc/self/fd/{entry}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(entry))) as probe:
                if probe.type == socket.SOCK_DGRAM and probe.family in (socket.AF_INET, socket.AF_INET6):
                    found.add(int(entry))
        except OSError:  # closed meanwhile: the descriptor of the listing itself
            continue
    return found


def _bind_to_device(descriptors: set[int], interface: str) -> None:
    """Make sockets receive from one interface only."""
    try:
        for descriptor in descriptors:
            with socket.socket(fileno=os.dup(descriptor)) as each:
                each.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
    except OSError as error:
        raise SecurityError(
            f"cannot keep DDS on {interface}, other computers could reach it: {error.strerror}; use Linux 5.7 or newer"
        ) from error
