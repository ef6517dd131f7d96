"""The wire of ``rmw_zenoh_cpp``: key expressions, liveliness tokens and attachments. Pure.

As in docs/design.md of https://github.com/ros2/rmw_zenoh. Attachments are as in versions from April 2025 on (Jazzy 0.2.4, Kilted 0.6.0);
earlier ones had labels between the numbers.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import xxhash

from nodes.linking.ros2.routes import Endpoint, dds_name
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import type_hash

NODE, PUBLISHER, SUBSCRIPTION = "NN", "MP", "MS"
_ADMIN = "@ros2_lv"
_BEST_EFFORT = "2"
# Sequence number, time, and the identity as a sequence: its length comes first, in Zenoh's serialisation.
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16
_CHUNKS = 12


@dataclass(frozen=True)
class Token:
    """A liveliness token of a publisher or a subscription.

    Attributes:
        key: The whole key expression.
        kind: ``MP`` or ``MS``.
        node: Namespace and name of the ROS node.
        typename: Name of the type in DDS.
        type_hash: ROS hash of the type.
    """

    key: str
    kind: str
    node: str
    typename: str
    type_hash: str

    @property
    def gid(self) -> str:
        """Identity that ``rmw_zenoh_cpp`` gives to this publisher, in hexadecimal."""
        return gid_of(self.key).hex()


@dataclass(frozen=True)
class Attachment:
    """What a publisher attaches to each sample.

    Attributes:
        sequence: Number of the sample, from 1.
        source_real_ns: When it was written, the publisher's CLOCK_REALTIME [ns].
        gid: Identity of the publisher, 16 bytes.
    """

    sequence: int
    source_real_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Bytes of the attachment."""
        return _ATTACHMENT.pack(self.sequence, self.source_real_ns, _GID_BYTES, self.gid)

    @classmethod
    def decode(cls, data: bytes) -> Attachment:
        """Read the bytes of an attachment. Any other bytes are a `MessageError`."""
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise MessageError(
                f"expected an attachment of rmw_zenoh ({_ATTACHMENT.size} bytes), got {len(data)} bytes;"
                " use ROS 2 packages from April 2025 or later"
            )
        sequence, source_real_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(sequence, source_real_ns, gid)


def topic_key(domain_id: int, endpoint: Endpoint) -> str:
    """Key expression of a topic's samples."""
    return (
        f"{domain_id}/{endpoint.ros.strip('/')}/{dds_name(endpoint.typename)}/{type_hash(endpoint.typename)}"
    )


def node_token(domain_id: int, session: str, node: str) -> str:
    """Liveliness token of a node without namespace; it is the first of its session."""
    return f"{_ADMIN}/{domain_id}/{session}/0/0/{NODE}/%/%/{node}"


def endpoint_token(
    domain_id: int, session: str, number: int, kind: str, node: str, endpoint: Endpoint
) -> str:
    """Liveliness token of a publisher or subscription of that node.

    Args:
        domain_id: ``ROS_DOMAIN_ID``.
        session: Zenoh's identity of the session, in hexadecimal.
        number: Number within the node, different for each of its tokens.
        kind: ``MP`` or ``MS``.
        node: Name of the node.
        endpoint: Topic, type and QoS.
    """
    qos = f"{'' if endpoint.reliable else _BEST_EFFORT}::,{endpoint.depth}:,:,:,,"
    name, typename = _mangled(endpoint.ros), endpoint.typename
    return (
        f"{_ADMIN}/{domain_id}/{session}/0/{number}/{kind}/%/%/{node}/{name}/{dds_name(typename)}"
        f"/{type_hash(typename)}/{qos}"
    )


def tokens_of(domain_id: int, ros_name: str) -> str:
    """Key expression that matches the tokens of every publisher and subscription of a topic."""
    return f"{_ADMIN}/{domain_id}/*/*/*/*/*/*/*/{_mangled(ros_name)}/**"


def parse_token(key: str) -> Token | None:
    """Read the token of a publisher or subscription; None for any other key expression."""
    chunks = key.split("/")
    if len(chunks) < _CHUNKS or chunks[0] != _ADMIN or chunks[5] not in (PUBLISHER, SUBSCRIPTION):
        return None
    namespace = chunks[7].replace("%", "/").rstrip("/")
    return Token(key, chunks[5], f"{namespace}/{chunks[8]}", chunks[10], chunks[11])


def gid_of(token: str) -> bytes:
    """Identity that ``rmw_zenoh_cpp`` derives from a liveliness token: its 128-bit XXH3 hash, least significant byte first."""
    return xxhash.xxh3_128(token.encode()).digest()[::-1]


def _mangled(name: str) -> str:
    return name.replace("/", "%")
