"""Decides which commands from ROS 2 count. Pure: time and messages come as arguments.

ROS 2 has no keys here, and the clock of another host is unknown. So a command counts only as the answer to a message that this node itself
sent a moment ago: it must carry that message's stamp. Its age is then measured by this host's clock alone, a recording or a flood
cannot forge it without reading along, and each message is answered at most once.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from dataclasses import dataclass, field

from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError

_REMEMBERED = 256
_LITTLE, _BIG = struct.Struct("<iI"), struct.Struct(">iI")
_HEADER_AT = 4  # after the encapsulation header of CDR


def stamp_of_cdr(cdr: bytes) -> int:
    """Stamp [ns] of a message whose first field is a ``std_msgs/Header``, without decoding the rest."""
    if len(cdr) < _HEADER_AT + _LITTLE.size or cdr[0] != 0 or cdr[1] not in (0, 1):
        raise MessageError(
            f"expected CDR bytes that begin with a header, got {len(cdr)} bytes {cdr[:4].hex()}"
        )
    sec, nanosec = (_LITTLE if cdr[1] else _BIG).unpack_from(cdr, _HEADER_AT)
    return int(sec) * NS_PER_S + int(nanosec)


class AnsweredStamps:
    """Compares the stamps of commands with the stamps of sent messages.

    Args:
        max_age_s: Largest age of a message when its answer arrives [s].
    """

    def __init__(self, max_age_s: float) -> None:
        self._limit_s = max_age_s
        self._sent_ns: OrderedDict[int, int] = OrderedDict()
        self._answered_sent_ns: int | None = None

    def sent(self, stamp_ns: int, mono_ns: int) -> None:
        """Note a message that ROS 2 gets.

        Args:
            stamp_ns: Stamp of the message [ns].
            mono_ns: Time of its publication on our bus, on this host's monotonic clock [ns].
        """
        self._sent_ns.setdefault(stamp_ns, mono_ns)
        while len(self._sent_ns) > _REMEMBERED:
            self._sent_ns.popitem(last=False)

    def refusal(self, stamp_ns: int, mono_ns: int) -> str:
        """Return why a command does not count; empty if it does, and then the message is answered.

        Args:
            stamp_ns: Stamp of the command [ns].
            mono_ns: Arrival of the command, this host's monotonic clock [ns].
        """
        sent_ns = self._sent_ns.get(stamp_ns)
        if sent_ns is None:
            return "its stamp is not that of a message sent to ROS 2; copy the stamp of the image into the command"
        if self._answered_sent_ns is not None and sent_ns <= self._answered_sent_ns:
            return "a newer message was already answered"
        if (age_s := (mono_ns - sent_ns) / NS_PER_S) > self._limit_s:
            return f"it answers a message {age_s:.2f} s old, the limit is {self._limit_s:g} s"
        # By the time of sending: a stamp of a wrong clock must not lock out the right ones.
        self._answered_sent_ns = sent_ns
        return ""


@dataclass
class OneWriter:
    """Accepts the only publisher of a topic. With two of them, none counts: it is unclear which one the operator means.

    Attributes:
        shared: Accept any number of publishers instead.
        present: Publishers that exist, by their identity.
    """

    shared: bool = False
    present: tuple[str, ...] = field(default=())

    @property
    def problem(self) -> str:
        """Why no message counts; empty if messages of the only publisher do."""
        if self.shared or len(self.present) < 2:
            return ""
        return f"{len(self.present)} publishers ({', '.join(self.present[:4])}); keep only the one that may drive, then arm again"

    def refusal(self, writer: str) -> str:
        """Return why a message does not count; empty if it does."""
        if self.problem:
            return self.problem
        return "" if writer in self.present else "its publisher is not announced, or already gone"
