"""The ROS 2 node: carries chosen topics to and from ROS 2 over DDS or Zenoh. ROS itself is not needed.

What comes in can only ask, as any policy does. A command counts if it answers a message that this node has just sent, and if its
publisher is the only one; then the safety node decides. No message from ROS can arm the car, or stand for the operator's hand.
"""

from __future__ import annotations

import hashlib
import secrets
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from calibration.schema import VehicleCalibration, load_calibration
from nodes.control.stamps import COMMAND_AGE_S, stamp_age_s, stamp_problem
from nodes.linking.link import on_our_clock
from nodes.linking.ros2.answers import stamp_of_cdr
from nodes.linking.ros2.carried import Rate, SentTopic, Taken
from nodes.linking.ros2.conversions import Setting
from nodes.linking.ros2.routes import SAFETY_DRIVE, SendRoute, TakeRoute, check_routes, needs_wheelbase
from nodes.linking.ros2.samples import Heard, Side
from nodes.linking.ros2.transports import Transport, is_loopback_interface, open_transport
from nodes.linking.ros2.zenoh_settings import ZenohSettings
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError, MessageError, SecurityError
from nodes.runtime.messages import decode, drive_message, encode, stamp_ns
from nodes.runtime.node import ACTIVE, FAULT, READY, Inbox, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import topic as topic_row
from nodes.runtime.wire import Meta, Relayed

_INBOX = 64
_QUEUE = 4
_ACTIVE_S = 1.0
_LATE_S = 0.25
_TICK_HZ = 20.0
_STOPS = 20  # for a second


class Ros2Config(StrictModel):
    """Configuration of the ROS 2 node.

    Attributes:
        transport: ``dds``, ``zenoh``, or ``auto``: DDS where it is installed, else Zenoh. The ROS programs must use the same.
        zenoh: Addresses and domain of the ROS programs over Zenoh.
        domain_id: ``ROS_DOMAIN_ID`` of the ROS programs.
        interface: Network interface. On any but the loopback, every computer of that network can read what is sent, and answer.
        open_to_network: Must be true for an interface other than the loopback, because ROS 2 has no keys here.
        vehicle: Vehicle calibration file with the wheelbase, for routes with ``geometry_msgs/msg/TwistStamped``.
        send: Topics that ROS 2 gets.
        take: Topics that ROS 2 supplies.
    """

    transport: Transport = "auto"
    zenoh: ZenohSettings = ZenohSettings()
    domain_id: int = Field(default=0, ge=0, le=232)
    interface: str = Field(default="lo", pattern=r"^[A-Za-z0-9_.\-]{1,15}$")
    open_to_network: bool = False
    vehicle: Path | None = None
    send: tuple[SendRoute, ...] = ()
    take: tuple[TakeRoute, ...] = ()

    @model_validator(mode="after")
    def _routes_fit(self) -> Ros2Config:
        if not self.send and not self.take:
            raise ValueError("expected at least one route in send or take, got none; add the topics to carry")
        check_routes(self.send, self.take)
        if needs_wheelbase((*self.send, *self.take)) and self.vehicle is None:
            raise ValueError(
                "expected 'vehicle' for routes with TwistStamped, which need the wheelbase; add it"
            )
        return self


class Ros2Node(Node):
    """Carries messages between the bus of this host and ROS 2.

    Args:
        on_this_host: Whether every publisher runs on this computer, so that its clock is ours.
        instance: Random text of this process. A restart of this node counts as a restart of the publishers.
    """

    opens = "a connection to ROS 2"
    raw = True
    tick_rate_hz = _TICK_HZ

    def __init__(
        self,
        config: Ros2Config,
        side: Side,
        inbox: Inbox[list[Heard]],
        wheelbase_m: float = 0.0,
        on_this_host: bool = True,
        instance: str = "",
    ) -> None:
        self._instance = instance
        self._config, self.inbox, self._side, self._on_this_host = config, inbox, side, on_this_host
        self.subscriptions = tuple(dict.fromkeys(route.topic for route in config.send))
        self.publications = tuple(route.topic for route in config.take)
        # Every image is carried, also if two arrive at once. Of a command only the newest counts.
        self.queues = {
            name: _QUEUE for name in self.subscriptions if name != SAFETY_DRIVE and topic_row(name).latest
        }
        self._sent: dict[str, list[tuple[int, SentTopic, Rate]]] = defaultdict(list)
        for number, send in enumerate(config.send):
            setting = Setting(wheelbase_m, send.child_frame, send.frame)
            self._sent[send.topic].append((number, SentTopic(send, setting), Rate(send.rate_hz)))
        setting = Setting(wheelbase_m)
        self._taken = [(Taken(route, setting), Rate(route.rate_hz)) for route in config.take]
        self._counts: Counter[str] = Counter()
        self._last_refusal = ""
        self._active_ns: int | None = None
        self._now_ns = self._now_real_ns = 0
        self._driven_ns: int | None = None  # the newest command to move that a driver in ROS got
        self._stops_left = 0
        self._closed = False

    @classmethod
    def build(cls, config: Ros2Config, context: NodeContext) -> Ros2Node:
        """Build the node and join the ROS programs."""
        local = is_loopback_interface(config.interface)
        require_local(config, local)
        wheelbase_m = (
            load_calibration(VehicleCalibration, config.vehicle).wheelbase_m if config.vehicle else 0.0
        )
        inbox: Inbox[list[Heard]] = Inbox(_INBOX)
        side = open_transport(
            config.transport,
            config.domain_id,
            config.interface,
            config.zenoh,
            [route.endpoint for route in config.send],
            [route.endpoint for route in config.take],
            inbox,
            sorted({number for route in config.take for number in answered(config, route)}),
        )
        return cls(config, side, inbox, wheelbase_m, local, secrets.token_hex(8))

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Send a message to ROS 2, unless it is too old."""
        self._now_ns, self._now_real_ns = now.mono_ns, now.real_ns
        for number, sent, rate in self._sent[topic]:
            age_s = (now.mono_ns - info.publish_mono_ns) / NS_PER_S
            if sent.max_age_s is not None and age_s > sent.max_age_s:
                self._counts[f"stale {topic}"] += 1
            elif not rate.due(now.mono_ns):
                self._counts[f"skipped {topic}"] += 1
            else:
                self._send(number, sent, info)
        return []

    def receive(self, item: list[Heard], now: Now) -> list[Out]:
        """Publish what ROS 2 supplies and what may pass."""
        self._now_ns, self._now_real_ns = now.mono_ns, now.real_ns
        outs: list[Out] = []
        for heard in item:
            taken, rate = self._taken[heard.reader]
            topic = taken.route.topic
            try:
                cdr = taken.cdr(heard)
            except MessageError as error:
                self._counts[f"refused {topic}"] += 1
                self._last_refusal = f"{taken.route.ros_name}: {error}"
                continue
            if not rate.due(heard.mono_ns):
                self._counts[f"skipped {topic}"] += 1
                continue
            outs.append(Out(topic, Relayed(self._meta(taken, heard), cdr)))
            taken.sequence += 1
            taken.passed_ns = self._active_ns = now.mono_ns
            self._counts[f"taken {topic}"] += 1
        return outs

    def tick(self, now: Now) -> list[Out]:
        """Look for publishers, and stop a car in ROS whose commands have ended."""
        self._now_ns, self._now_real_ns = now.mono_ns, now.real_ns
        for number, (taken, _) in enumerate(self._taken):
            taken.writer.present = self._side.present(number)
            taken.mismatch = self._side.mismatch(number)
            if taken.route.answers is not None:
                taken.rivals = tuple(
                    rival
                    for watched in answered(self._config, taken.route)
                    for rival in self._side.rivals(watched)
                )
        if self._driven_ns is not None and now.mono_ns - self._driven_ns > _LATE_S * NS_PER_S:
            self._driven_ns, self._stops_left = None, _STOPS
        if self._stops_left > 0:
            self._stops_left -= 1
            self._stop(now.real_ns)
        return []

    def status(self) -> tuple[str, str]:
        """Report a fault if a topic has two publishers."""
        for taken, _ in self._taken:
            if taken.problem:
                return FAULT, f"{taken.route.ros_name}: {taken.problem}"
        for taken, _ in self._taken:
            if taken.mismatch:
                return READY, taken.mismatch
            if not taken.writer.present:
                return READY, f"no publisher of {taken.route.ros_name} ({taken.route.ros_type}) yet"
        silent = next((taken for taken, _ in self._taken if not self._recent(taken.passed_ns)), None)
        if silent is not None and self._last_refusal:
            return READY, f"refused {self._last_refusal}"
        if silent is not None:
            return READY, f"{silent.route.ros_name} is silent"
        total = sum(count for name, count in self._counts.items() if name.startswith(("sent ", "taken ")))
        return (ACTIVE if self._recent(self._active_ns) else READY), f"{total} messages carried"

    def counters(self) -> dict[str, float]:
        """Report carried, skipped and refused messages, and the subscribers in ROS of each sent topic."""
        if self._closed:
            return {name: float(count) for name, count in self._counts.items()}
        readers = {
            f"readers {sent.route.ros_name}": float(self._side.readers_of(number))
            for entries in self._sent.values()
            for number, sent, _ in entries
        }
        return {**{name: float(count) for name, count in self._counts.items()}, **readers}

    def close(self) -> None:
        """Stop a car in ROS, and leave the domain."""
        self._closed = True
        try:
            if self._driven_ns is not None:
                self._stop(self._now_real_ns)
        finally:
            self._side.close()

    def _send(self, number: int, sent: SentTopic, info: MessageInfo) -> None:
        topic = sent.route.topic
        for taken, _ in self._taken:
            if taken.answers is not None and taken.route.answers == topic:
                taken.answers.sent(stamp_of_cdr(info.raw), info.publish_mono_ns)
        if topic == SAFETY_DRIVE:
            drive = decode(sent.route.table_type, info.raw)
            moves = float(drive.drive.speed) != 0.0
            if moves and stamp_problem(stamp_age_s(stamp_ns(drive), self._now_real_ns), COMMAND_AGE_S):
                self._counts[f"stale {topic}"] += 1
                return
            self._driven_ns, self._stops_left = (info.publish_mono_ns if moves else None), 0
        if self._side.write(number, sent.cdr(info.raw)):
            self._counts[f"sent {topic}"] += 1
            self._active_ns = self._now_ns
        else:
            self._counts[f"full {topic}"] += 1

    def _stop(self, real_ns: int) -> None:
        """Send zero to every driver in ROS that gets the safety node's commands."""
        raw = encode(drive_message(0.0, 0.0, real_ns))
        for number, sent, _ in self._sent[SAFETY_DRIVE]:
            self._side.write(number, sent.cdr(raw))
            self._counts["stops"] += 1

    def _meta(self, taken: Taken, heard: Heard) -> Meta:
        # Another publisher counts as a restart: the operator armed the car with the earlier one. Many together count as one.
        writer = "" if taken.writer.shared else heard.writer
        instance_id = int.from_bytes(
            hashlib.sha256(f"{self._instance} {writer}".encode()).digest()[:8], "big"
        )
        # The publisher's clock says how long the message was on its way only if it is our own clock.
        real_ns = heard.source_real_ns if self._on_this_host else heard.real_ns
        meta = Meta(0, min(max(real_ns, 0), heard.real_ns), taken.sequence, taken.prefix, instance_id)
        return on_our_clock(meta, heard.real_ns, heard.mono_ns)

    def _recent(self, mono_ns: int | None) -> bool:
        return mono_ns is not None and self._now_ns - mono_ns < _ACTIVE_S * NS_PER_S


def answered(config: Ros2Config, route: TakeRoute) -> list[int]:
    """Numbers of the routes that send what a command answers."""
    return [number for number, send in enumerate(config.send) if send.topic == route.answers]


def require_local(config: Ros2Config, local: bool) -> None:
    """Refuse what may not leave this computer unless the user says so, and what must not come from another one."""
    if local:
        return
    if not config.open_to_network:
        raise SecurityError(
            f"{config.interface} opens ROS 2 to every computer on that network, without keys; use interface lo, or set"
            " open_to_network: true"
        )
    if foreign := [route.topic for route in config.take if not route.commands]:
        raise ConfigError(
            f"expected only commands from other computers, got {', '.join(foreign)}: the age of a measurement needs a clock that"
            " is compared with ours. Run this node on the computer of the ROS driver, and connect both hosts as in docs/two_hosts.md"
        )


if __name__ == "__main__":
    raise SystemExit(run_node_main(Ros2Config, Ros2Node.build))
