"""What the ROS 2 node and its transports pass to each other. Each transport implements `Side`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Heard:
    """A sample from ROS 2.

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


class Side(Protocol):
    """The end of the ROS 2 node in a ROS 2 network. Routes are numbered as in the configuration."""

    def write(self, number: int, cdr: bytes) -> bool:
        """Write CDR bytes without blocking; False if the queue is full."""
        ...

    def present(self, number: int) -> tuple[str, ...]:
        """Identities of the publishers of a taken topic."""
        ...

    def mismatch(self, number: int) -> str:
        """Why publishers of a taken topic are not heard; empty if there are none of these."""
        ...

    def rivals(self, number: int) -> tuple[str, ...]:
        """Identities of the other publishers of a sent topic that commands answer."""
        ...

    def readers_of(self, number: int) -> int:
        """Number of subscribers of a sent topic."""
        ...

    def close(self) -> None:
        """Leave the network."""
        ...
