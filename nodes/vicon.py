"""The VICON node: publishes a topic of poses for each tracked subject. Unreliable poses are not published."""

from __future__ import annotations

import ipaddress
import time
from typing import Annotated

from pydantic import Field, field_validator

from advnerf_core.strict import StrictModel, at_most
from hardware.mocap.library import LibraryConfig, LibraryReceiver
from hardware.mocap.vicon import DEFAULT_PORT, SubjectPose, ViconConfig, ViconReceiver
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import TopicError
from nodes.runtime.messages import pose_message
from nodes.runtime.node import (
    ACTIVE,
    FAULT,
    STARTING,
    Inbox,
    Node,
    NodeContext,
    Now,
    Out,
    ReaderThread,
)
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import topic

_READ_TIMEOUT_S = 0.2
_TOPIC_PREFIX = "/vicon/"


class ViconNodeConfig(StrictModel):
    """Configuration of the VICON node.

    Attributes:
        host: Local address to listen on; empty for all.
        port: UDP port of Tracker's object stream.
        source: Accept only datagrams from this address.
        library: Use this system of the library ``motioncapture`` (vicon, optitrack, qualisys, ...) at ``hostname`` instead of
            Tracker's object stream.
        hostname: Computer of that system.
        subjects: Subjects to publish, each on ``/vicon/<subject>``.
        latency_s: Measured delay from exposure to reception [s].
        frozen_frames: Number of bit-identical frames after which a subject counts as lost.
        max_age_s: Largest age of a pose at its publication; older poses are dropped [s].
        silence_s: Time without any pose of the first subject after which the node reports a fault [s].
    """

    host: str = "127.0.0.1"
    port: int = Field(default=DEFAULT_PORT, ge=0, le=65535)
    source: str | None = None
    library: str | None = None
    hostname: str = "localhost"
    subjects: tuple[str, ...] = Field(default=("car", "board", "monitor"), min_length=1)
    latency_s: Annotated[float, at_most(1.0, "s", "ms")] = Field(default=0.0, ge=0.0)
    frozen_frames: int = Field(default=5, ge=2, le=50)
    max_age_s: float = Field(default=0.1, gt=0.0)
    silence_s: float = Field(default=0.5, gt=0.0)

    @field_validator("source")
    @classmethod
    def _an_address(cls, source: str | None) -> str | None:
        try:
            return None if source is None else str(ipaddress.IPv4Address(source))
        except ValueError:
            raise ValueError("expected an IPv4 address, as datagrams have no names of computers") from None

    @field_validator("subjects")
    @classmethod
    def _have_topics(cls, subjects: tuple[str, ...]) -> tuple[str, ...]:
        for subject in subjects:
            try:
                topic(_TOPIC_PREFIX + subject)
            except TopicError as error:
                raise ValueError(f"{error}; a new subject needs a row in nodes/runtime/topics.py") from None
        return subjects


class ViconNode(Node):
    """Publishes poses as messages."""

    opens = "a UDP port"

    def __init__(self, config: ViconNodeConfig) -> None:
        self._config = config
        self._receiver = _receiver(config)
        self.publications = tuple(_TOPIC_PREFIX + subject for subject in config.subjects)
        self.inbox: Inbox[list[SubjectPose]] = Inbox(capacity=50)
        self._reader = ReaderThread(self._read, self.inbox, "vicon")
        self._seen_ns: dict[str, int] = {}
        self._now_ns = time.monotonic_ns
        self._stale = 0
        self._read_fault = ""

    @classmethod
    def build(cls, config: ViconNodeConfig, context: NodeContext) -> ViconNode:
        """Build the node and start listening."""
        node = cls(config)
        node._now_ns = lambda: context.clock.now().mono_ns
        node._reader.start()
        return node

    @property
    def port(self) -> int:
        """UDP port on which the node listens; 0 with the library."""
        return self._receiver.port if isinstance(self._receiver, ViconReceiver) else 0

    def receive(self, item: list[SubjectPose], now: Now) -> list[Out]:
        """Publish poses."""
        outs = []
        for pose in item:
            if (now.mono_ns - pose.receive_mono_ns) / NS_PER_S > self._config.max_age_s:
                self._stale += 1  # the pose waited while this process was held up
                continue
            self._seen_ns[pose.name] = now.mono_ns
            message = pose_message(pose.T_world_from_subject, pose.stamp_real_ns)
            outs.append(Out(_TOPIC_PREFIX + pose.name, message))
        return outs

    def status(self) -> tuple[str, str]:
        """Report a fault while the first subject is not seen, or any subject has two senders."""
        now_ns, first = self._now_ns(), self._config.subjects[0]
        if fault := self._receiver.fault(now_ns):
            return FAULT, fault
        lost = [
            name for name in self._config.subjects if self._silence_s(name, now_ns) > self._config.silence_s
        ]
        text = f"not seen: {', '.join(lost)}" if lost else ""
        if first not in self._seen_ns:
            return (
                STARTING,
                text if self._receiver.counts.datagrams else self._receiver.silence,
            )
        return (FAULT if first in lost else ACTIVE), text

    def counters(self) -> dict[str, float]:
        """Report counts of datagrams and poses."""
        counts = self._receiver.counts
        totals: dict[str, float] = {
            "datagrams": counts.datagrams,
            "refused": counts.refused,
            "from_elsewhere": counts.elsewhere,
            "late": counts.late,
            "stale": self._stale,
            "frames_missed": counts.missed_frames,
            "restarts": counts.restarts,
            "disputed": counts.disputed,
        }
        return totals | {f"lost {name}": float(count) for name, count in counts.lost.items()}

    def close(self) -> None:
        """Stop listening."""
        self._reader.stop()
        self._receiver.close()

    def _read(self) -> list[SubjectPose] | None:
        poses = self._receiver.read(_READ_TIMEOUT_S)
        before, self._read_fault = self._read_fault, self._receiver.fault(time.monotonic_ns())
        # During a fault no poses arrive, so the node must be woken to report it.
        return poses if poses or self._read_fault != before else None

    def _silence_s(self, name: str, now_ns: int) -> float:
        return (now_ns - self._seen_ns.get(name, 0)) / NS_PER_S


def _receiver(config: ViconNodeConfig) -> ViconReceiver | LibraryReceiver:
    if config.library is None:
        return ViconReceiver(
            ViconConfig(
                config.subjects,
                config.host,
                config.port,
                config.latency_s,
                config.frozen_frames,
                config.source,
            )
        )
    return LibraryReceiver(
        LibraryConfig(
            config.library, config.hostname, config.subjects, config.latency_s, config.frozen_frames
        )
    )


if __name__ == "__main__":
    raise SystemExit(run_node_main(ViconNodeConfig, ViconNode.build))
