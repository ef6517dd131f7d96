"""Samples that the DDS end passes to the ROS 2 node."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Heard:
    """A sample from DDS.

    Attributes:
        reader: Number of the reader.
        cdr: The bytes.
        writer: Identity of its publisher.
        stated_hash: ROS hash of the type by which the publisher encodes; empty if it states none.
        present: Identities of all publishers of the topic at this moment.
        source_real_ns: When the publisher says that it wrote it, by its own real-time clock [ns].
        mono_ns: When this process took it, monotonic clock [ns].
        real_ns: The same moment, CLOCK_REALTIME [ns].
    """

    reader: int
    cdr: bytes
    writer: str
    stated_hash: str
    present: tuple[str, ...]
    source_real_ns: int
    mono_ns: int
    real_ns: int
