"""Wire format between processes: three frames ``[topic, meta, cdr]``. Pure bytes, no sockets."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from nodes.runtime.errors import MessageError
from nodes.runtime.messages import type_hash_prefix
from nodes.runtime.topics import topic as topic_row

# publish monotonic ns, publish real ns, sequence, first 8 bytes of the RIHS01 type hash, publisher instance id.
_META = struct.Struct("<QQQ8sQ")
META_BYTES = _META.size


@dataclass(frozen=True)
class MessageInfo:
    """Transport data of a received message.

    Attributes:
        publish_mono_ns: Monotonic time of publication [ns], valid only on the publisher's host.
        receive_mono_ns: Monotonic time at which this process read it from its socket [ns].
        sequence: Number of the message from this publisher on this topic, from 0.
        raw: The CDR bytes.
        publish_real_ns: Real time of publication [ns].
        receive_real_ns: Real time at which this process read it from its socket [ns].
        instance_id: Random number that the publisher draws when it starts. A change means that it was restarted.
        lost: Messages of the topic that were published just before this one but not received.
    """

    publish_mono_ns: int
    receive_mono_ns: int
    sequence: int = 0
    raw: bytes = b""
    publish_real_ns: int = 0
    receive_real_ns: int = 0
    instance_id: int = 0
    lost: int = 0

    @property
    def fresh_mono_ns(self) -> int:
        """Time from which the age of the message counts [ns]: its publication, or its receipt if that claims to be in the future."""
        return min(self.publish_mono_ns, self.receive_mono_ns)


@dataclass(frozen=True)
class Meta:
    """Content of the second frame."""

    publish_mono_ns: int
    publish_real_ns: int
    sequence: int
    type_prefix: bytes
    instance_id: int


@dataclass(frozen=True)
class Relayed:
    """A message from another host, to be forwarded with its publisher's sequence number and times."""

    meta: Meta
    cdr: bytes


def pack_meta(meta: Meta) -> bytes:
    """Pack the second frame."""
    return _META.pack(
        meta.publish_mono_ns, meta.publish_real_ns, meta.sequence, meta.type_prefix, meta.instance_id
    )


def unpack(topic: str, frames: Sequence[bytes]) -> tuple[Meta, bytes]:
    """Unpack a received message to meta and CDR bytes. Other topics, formats and types are refused before decoding."""
    meta, parts = unpack_parts(topic, frames)
    return meta, parts[0] if len(parts) == 1 else b"".join(parts)


def unpack_parts(topic: str, frames: Sequence[bytes]) -> tuple[Meta, Sequence[bytes]]:
    """Unpack a received message to meta and the frames of its CDR bytes."""
    if len(frames) < 3 or frames[0] != topic.encode() or len(frames[1]) != META_BYTES:
        raise MessageError(
            f"expected frames [topic, {META_BYTES} bytes, cdr] on {topic}, got {[len(f) for f in frames]} bytes"
        )
    meta = Meta(*_META.unpack(frames[1]))
    typename = topic_row(topic).type
    expected = type_hash_prefix(typename)
    if meta.type_prefix != expected:
        raise MessageError(
            f"{topic}: expected {typename} with type hash {expected.hex()}, got {meta.type_prefix.hex()}; "
            "run the same version of advnerf on both sides"
        )
    return meta, frames[2:]
