"""The safety node: lets commands through while the car is armed and everything is well, and says stop otherwise.

A hand on the gamepad or keyboard goes before the drivers, and of these the first in ``drivers`` before the next.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from calibration.schema import RoomCalibration, load_calibration
from nodes.arming import Arming, ArmingLimits
from nodes.arming_gates import ClockGate, HandGate, inside, require_simple
from nodes.arming_requests import ArmRequests
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import drive_message, header, ns_from_stamp, types
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out, run_node_main
from nodes.runtime.requests import asked_mono_ns
from nodes.runtime.topics import STATUS_PREFIX, status_topic

_TICK_RATE_HZ = 50.0
_STOP_PERIOD_S = 0.04
_STATE_PERIOD_S = 0.1


class SafetyConfig(BaseModel):
    """Configuration of the safety node.

    Attributes:
        room: Room calibration file: the fence.
        nodes: Nodes whose status must be fresh and good.
        drivers: Who may command, first the one that goes before the others: expert, policy.
        teleop: ``hold``: the car moves only while somebody holds a button (see the teleop node); ``none``: once armed.
        teleop_age_limit_s: Silence of the teleop node after which the button counts as released [s].
        fence_margin_m: The rear axle stays at least this far inside the room's fence [m].
        clock_offset_limit_s: Largest offset between the clocks of two hosts [s].
        clock_error_limit_s: An offset known no better than this is not known [s].
        clock_peers: Hosts whose clock offset must be known; others count too once they were heard.
        max_speed_mps: A faster command disarms [m/s].
        max_steering_rad: A sharper command than this disarms; the car's own limits are the motor node's [rad].
        drive_age_limit_s: Oldest command of the policy [s].
        image_age_limit_s: Oldest camera image [s].
        pose_age_limit_s: Oldest pose of the car [s].
        status_age_limit_s: Oldest status of a node [s].
        held_up_limit_s: A pause of this process after which it disarms [s].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    room: Path
    nodes: tuple[str, ...] = ("camera", "vicon", "compositor", "policy", "motor")
    drivers: tuple[Literal["expert", "policy"], ...] = Field(default=("policy",), min_length=1)
    teleop: Literal["none", "hold"] = "none"
    teleop_age_limit_s: float = Field(default=0.2, gt=0.05, le=0.25)
    fence_margin_m: float = Field(default=0.0, ge=0.0)
    clock_offset_limit_s: float = Field(default=0.03, gt=0.0, le=0.1)
    clock_error_limit_s: float = Field(default=0.1, gt=0.0)
    clock_peers: tuple[str, ...] = ()
    max_speed_mps: float = Field(default=1.0, gt=0.0)
    max_steering_rad: float = Field(default=0.6, gt=0.0)
    drive_age_limit_s: float = Field(default=0.22, gt=0.0, le=0.25)
    image_age_limit_s: float = Field(default=0.25, gt=0.0, le=0.3)
    pose_age_limit_s: float = Field(default=0.2, gt=0.0, le=0.25)
    status_age_limit_s: float = Field(default=1.0, gt=0.2)
    held_up_limit_s: float = Field(default=0.2, gt=0.04, le=0.25)

    def limits(self, room: RoomCalibration) -> ArmingLimits:
        """Numbers for the state machine; a fence that would never let the car drive is refused."""
        require_simple(room.fence_m)
        if not inside(room.start_pose[:2], room.fence_m):
            raise ConfigError(
                f"expected a fence about the start, got start_pose {room.start_pose} outside of fence_m in {self.room}"
            )
        return ArmingLimits(
            nodes=self.nodes, fence_m=room.fence_m, drivers=self.drivers, fence_margin_m=self.fence_margin_m, drive_age_s=self.drive_age_limit_s, image_age_s=self.image_age_limit_s,
            pose_age_s=self.pose_age_limit_s, status_age_s=self.status_age_limit_s, held_up_s=self.held_up_limit_s,
            speed_mps=self.max_speed_mps, steering_rad=self.max_steering_rad,
        )  # fmt: skip


class SafetyNode(Node):
    """Connects the arming state machine with the bus."""

    publications = ("/safety/drive", "/safety/state")
    tick_rate_hz = _TICK_RATE_HZ

    def __init__(self, limits: ArmingLimits, hand: HandGate | None = None, clocks: ClockGate | None = None) -> None:
        self._arming = Arming(limits, hand or HandGate(), clocks or ClockGate())
        self._requests = ArmRequests(self._arming)
        self._topic_of = {f"/{driver}/drive": driver for driver in limits.drivers}
        self._stopped_ns = 0
        self._stated_ns = 0
        self._stated_armed: bool | None = None
        self._stops = 0
        self.subscriptions = (
            "/arm", "/teleop/state", "/clock/offset", "/camera/camera_info", "/vicon/car", "/motor/sent", *self._topic_of,
            *map(status_topic, limits.nodes),
        )  # fmt: skip

    @classmethod
    def build(cls, config: SafetyConfig, context: NodeContext) -> SafetyNode:
        """Make the node of a process."""
        del context  # it needs no clock of its own
        hand = HandGate(config.teleop == "hold", config.teleop_age_limit_s)
        clocks = ClockGate(config.clock_offset_limit_s, config.clock_error_limit_s, config.clock_peers)
        return cls(config.limits(load_calibration(RoomCalibration, config.room)), hand, clocks)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Note what came; pass a command on if it may pass."""
        arming = self._arming
        if topic in self._topic_of:
            return self._pass_on(self._topic_of[topic], message, info, now)
        if topic == "/teleop/state":
            return self._hand(message, info, now)
        if topic == "/arm":
            return self._obey(message, info, now)
        if topic == "/clock/offset":
            arming.clocks.heard(str(message.peer), float(message.offset_s), float(message.error_s), info)
        elif topic == "/camera/camera_info":
            arming.heard_camera(info)
        elif topic == "/vicon/car":
            arming.heard_car(float(message.pose.position.x), float(message.pose.position.y), info)
        elif topic == "/motor/sent":
            arming.peer = str(message.peer)
        elif topic.startswith(STATUS_PREFIX):
            arming.heard_status(topic.removeprefix(STATUS_PREFIX), str(message.state), str(message.text), info)
        arming.check(now.mono_ns)
        return self._news(now)

    def tick(self, now: Now) -> list[Out]:
        """Check, and while disarmed say stop, again and again."""
        self._arming.check(now.mono_ns)
        outs = self._news(now)
        if not self._arming.armed and now.mono_ns - self._stopped_ns >= _STOP_PERIOD_S * NS_PER_S:
            outs.append(self._stop(now))
        if now.mono_ns - self._stated_ns >= _STATE_PERIOD_S * NS_PER_S:
            outs.append(self._state(now))
        return outs

    def status(self) -> tuple[str, str]:
        """Active while armed."""
        arming = self._arming
        return (ACTIVE, f"armed by {arming.source}") if arming.armed else (READY, f"disarmed: {arming.reason}")

    def counters(self) -> dict[str, float]:
        """How often it had to stop the car."""
        return {"disarmed": self._stops}

    def _hand(self, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        speed, steering = float(message.speed_mps), float(message.steering_rad)
        passes = self._arming.heard_hand(
            str(message.mode), bool(message.estop), speed, steering, info, now.mono_ns
        )  # fmt: skip
        drive = [Out("/safety/drive", drive_message(speed, steering, now.real_ns))] if passes else []
        return self._news(now) + drive

    def _pass_on(self, driver: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        drive, capture_ns = message.drive, ns_from_stamp(message.header.stamp)
        speed, steering = float(drive.speed), float(drive.steering_angle)
        if self._arming.heard_drive(speed, steering, capture_ns, info, now.mono_ns, now.real_ns, driver):
            return [Out("/safety/drive", drive_message(speed, steering, capture_ns))]
        return self._news(now)

    def _obey(self, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Do what a person asks, and answer every repeat of it."""
        ask_id, source, asked_ns = (
            str(message.ask_id),
            str(message.source),
            min(asked_mono_ns(message, info), now.mono_ns),
        )
        if message.arm:
            self._requests.arm(ask_id, source, asked_ns, now.mono_ns)
        else:
            self._requests.disarm(ask_id, f"disarmed by {source}: {message.reason}", asked_ns, now.mono_ns)
        self._arming.check(now.mono_ns)
        return self._news(now) or [self._state(now)]

    def _news(self, now: Now) -> list[Out]:
        """What must be said at once when the car was armed or disarmed."""
        if self._arming.armed is self._stated_armed:
            return []
        if self._stated_armed:
            self._stops += 1
            return [self._stop(now), self._state(now)]
        return [self._state(now)]

    def _stop(self, now: Now) -> Out:
        self._stopped_ns = now.mono_ns
        return Out("/safety/drive", drive_message(0.0, 0.0, now.real_ns))

    def _state(self, now: Now) -> Out:
        self._stated_ns, self._stated_armed = now.mono_ns, self._arming.armed
        arming, answer = self._arming, self._requests.last
        message = types.SafetyState(
            header=header(now.real_ns), armed=arming.armed, stopping=not arming.armed, reason=arming.reason,
            source=arming.source if arming.armed else "", answered_id=answer.ask_id, granted=answer.granted, answer=answer.text,
            command_age_s=arming.drive_age_s(now.mono_ns),
            pose_age_s=arming.pose_age_s(now.mono_ns),
        )  # fmt: skip
        return Out("/safety/state", message)


def main() -> int:
    """Run the node as a process."""
    return run_node_main(SafetyConfig, SafetyNode.build)


if __name__ == "__main__":
    raise SystemExit(main())
