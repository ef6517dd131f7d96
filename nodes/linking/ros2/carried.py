"""The state of each carried topic: what a message must be like to pass, and its bytes on the other side. Pure."""

from __future__ import annotations

from nodes.linking.ros2.answers import AnsweredStamps, OneWriter, stamp_of_cdr
from nodes.linking.ros2.conversions import COMPRESSED, IMAGE, Setting, conversion
from nodes.linking.ros2.routes import SHARED, SendRoute, TakeRoute
from nodes.linking.ros2.samples import Heard
from nodes.linking.sockets import MOST_BYTES
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import decode, encode, type_hash, type_hash_prefix
from nodes.runtime.topics import topic as topic_row

_SMALL_BYTES = 64 * 2**10
_LARGE = (IMAGE, COMPRESSED)


class Taken:
    """State of one taken topic."""

    def __init__(self, route: TakeRoute, setting: Setting) -> None:
        self.route, self._setting = route, setting
        self.writer = OneWriter(route.topic in SHARED)
        self.rivals: tuple[str, ...] = ()
        self.answers = AnsweredStamps(route.max_age_s) if route.answers else None
        self.sequence = 0
        self.passed_ns: int | None = None
        self.mismatch = ""
        self._hash = type_hash(route.ros_type)
        self.prefix = type_hash_prefix(route.table_type)
        self._most_bytes = MOST_BYTES if route.ros_type in _LARGE else _SMALL_BYTES
        self._convert = (
            conversion(route.table_type, route.ros_type, outward=False) if route.converts else None
        )

    @property
    def problem(self) -> str:
        """Why nothing of the topic may pass; empty if it may."""
        if self.rivals:
            return f"somebody else publishes what it answers ({self.route.answers}): {', '.join(self.rivals[:4])}; stop that program, then arm again"
        return self.writer.problem

    def cdr(self, heard: Heard) -> bytes:
        """CDR bytes of the topic's own type. A message that must not pass is a `MessageError`."""
        self.writer.present = heard.present
        if refusal := self.problem or self.writer.refusal(heard.writer):
            raise MessageError(refusal)
        if heard.stated_hash not in ("", self._hash):
            raise MessageError(
                f"its publisher has another definition of {self.route.ros_type}; use the same version of the message package"
            )
        if len(heard.cdr) > self._most_bytes:
            raise MessageError(f"expected at most {self._most_bytes} bytes, got {len(heard.cdr)}")
        message = decode(self.route.ros_type, heard.cdr)
        converted = heard.cdr if self._convert is None else encode(self._convert(message, self._setting))
        if self.answers is not None and (
            refusal := self.answers.refusal(stamp_of_cdr(heard.cdr), heard.mono_ns)
        ):
            raise MessageError(refusal)
        return converted


class SentTopic:
    """State of one sent topic."""

    def __init__(self, route: SendRoute, setting: Setting) -> None:
        self.route, self._setting = route, setting
        self.max_age_s = topic_row(route.topic).max_age_s
        self._convert = conversion(route.table_type, route.ros_type, outward=True) if route.converts else None

    def cdr(self, raw: bytes) -> bytes:
        """CDR bytes of the type in ROS."""
        if self._convert is None:
            return raw
        return encode(self._convert(decode(self.route.table_type, raw), self._setting))


class Rate:
    """Skips messages that come faster than a rate."""

    def __init__(self, rate_hz: float | None) -> None:
        # A tenth of a period early counts as on time, because messages arrive on another grid.
        self._least_ns = 0 if rate_hz is None else round(0.9 / rate_hz * NS_PER_S)
        self._passed_ns: int | None = None

    def due(self, mono_ns: int) -> bool:
        """Whether a message may pass now."""
        if self._passed_ns is not None and mono_ns - self._passed_ns < self._least_ns:
            return False
        self._passed_ns = mono_ns
        return True
