"""The safety node: forwards commands while the car is armed and all checks pass, and sends stops otherwise.

The operator on gamepad or keyboard has priority over the drivers, and these are listed in order of priority in ``drivers``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import LagS, LengthM, RightAngleRad, SpeedMps, StrictModel
from calibration.fence import edge_distance_m
from calibration.schema import RoomCalibration, VehicleCalibration, load_calibration
from hardware.cameras.interface import RECORDED
from nodes.control.arming import MAX_SPEED_MPS, Arming, ArmingLimits
from nodes.control.arming_gates import ClockGate, HandGate
from nodes.control.arming_requests import ArmRequests
from nodes.control.pose_check import MotionBounds, PoseCheck, PoseGate
from nodes.control.stall_check import StallGate, StallLimits
from nodes.control.stamps import (
    AHEAD_LIMIT_S,
    REQUEST_AGE_S,
    ClockWatch,
    captured_mono_ns,
    stamp_age_s,
    stamp_problem,
)
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError, MessageError
from nodes.runtime.messages import drive_message, header, pose_matrix, types
from nodes.runtime.messages import stamp_ns as stamp_of
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.requests import asked_mono_ns
from nodes.runtime.topics import STATUS_PREFIX, status_topic

_TICK_RATE_HZ = 50.0
_STOP_PERIOD_S = 0.04
_STATE_PERIOD_S = 0.1


class SafetyConfig(StrictModel):
    """Configuration of the safety node.

    Attributes:
        room: Room calibration file with the fence.
        vehicle: Vehicle calibration file, which limits the possible motion of the car.
        nodes: Nodes whose status must be fresh and without a fault.
        drivers: Nodes that may command the car, highest priority first: expert, policy.
        teleop: ``hold``: the car moves only while a button is held (see the teleop node); ``none``: once armed.
        teleop_age_limit_s: Time without a message of the teleop node after which the button counts as released [s].
        fence_margin_m: Smallest distance of the rear axle inside the room's fence [m].
        clock_offset_limit_s: Largest accepted offset between the clocks of two hosts [s].
        clock_error_limit_s: Largest accepted error bound of an offset [s].
        clock_peers: Hosts whose clock offset must be known. Other hosts are checked once they have been measured.
        max_speed_mps: Largest commanded speed; a larger one disarms [m/s].
        max_steering_rad: Largest commanded steering angle; a larger one disarms. The motor node applies the car's own limits [rad].
        drive_age_limit_s: Largest age of the driver's newest command [s].
        image_age_limit_s: Largest age of the newest camera image [s].
        pose_age_limit_s: Largest age of the car's newest pose [s].
        status_age_limit_s: Largest age of a node's newest status [s].
        held_up_limit_s: Longest pause of this process; a longer one disarms [s].
        motion_margin: Factor over the limits of the vehicle calibration beyond which a motion disarms. 1.25 allows for gains that are
            a few per cent off and an overshooting speed controller; no car is a quarter faster than commanded.
        pose_noise_m: Largest noise of the distance between two poses [m]. 5 mm is seven standard deviations of the difference of two
            positions with 0.5 mm each: no false stop in years at 100 Hz.
        pose_noise_rad: Largest noise of the angle between two poses [rad]: seven standard deviations with 1 mrad each.
        stall_command_mps: Smallest commanded speed at which stalls are detected [m/s]. A VESC stands still below 0.2 m/s (its smallest
            closed-loop speed), and starts roughly just above it.
        stall_speed_mps: Measured speed below which the car is at rest [m/s]: a third of the smallest checked command, ten times the
            noise of the measurement.
        stall_time_s: Time at rest after which a car that is commanded to move is stalled [s]. A standing start needs 0.1 s for the
            command's latency, 0.1 s for the speed ramp (3.5 m/s^2 up to 0.3 m/s), 0.15 s for the motor's lag and up to 0.5 s for a
            sensorless motor to find its rotor position.
        stall_sources: Measurements of the motion: motion capture, the motor controller's rpm. Either at rest is a stall. On a test
            stand, where the wheels turn and the car does not move, use only ``erpm``.
    """

    room: Path
    vehicle: Path
    nodes: tuple[str, ...] = ("camera", "vicon", "compositor", "policy", "motor")
    drivers: tuple[Literal["expert", "policy"], ...] = Field(default=("policy",), min_length=1)
    teleop: Literal["none", "hold"] = "none"
    teleop_age_limit_s: float = Field(default=0.2, gt=0.05, le=0.25)
    fence_margin_m: LengthM = Field(default=0.0, ge=0.0)
    clock_offset_limit_s: float = Field(default=0.03, gt=0.0, le=0.1)
    clock_error_limit_s: LagS = Field(default=0.1, gt=0.0)
    clock_peers: tuple[str, ...] = ()
    max_speed_mps: SpeedMps = Field(default=MAX_SPEED_MPS, gt=0.0)
    max_steering_rad: RightAngleRad = Field(default=0.6, gt=0.0)
    drive_age_limit_s: float = Field(default=0.22, gt=0.0, le=0.25)
    image_age_limit_s: float = Field(default=0.25, gt=0.0, le=0.3)
    pose_age_limit_s: float = Field(default=0.2, gt=0.0, le=0.25)
    status_age_limit_s: LagS = Field(default=1.0, gt=0.2)
    held_up_limit_s: float = Field(default=0.2, gt=0.04, le=0.25)
    motion_margin: float = Field(default=1.25, ge=1.0, le=3.0)
    pose_noise_m: float = Field(default=0.005, gt=0.0, le=0.05)
    pose_noise_rad: float = Field(default=0.01, gt=0.0, le=0.1)
    stall_command_mps: SpeedMps = Field(default=0.3, gt=0.0)
    stall_speed_mps: SpeedMps = Field(default=0.1, gt=0.0)
    stall_time_s: float = Field(default=1.0, ge=0.3, le=10.0)
    stall_sources: tuple[Literal["mocap", "erpm"], ...] = Field(default=("mocap", "erpm"), min_length=1)

    @model_validator(mode="after")
    def _stall_is_slower_than_its_command(self) -> SafetyConfig:
        if self.stall_speed_mps >= self.stall_command_mps:
            raise ValueError(
                f"expected stall_speed_mps below stall_command_mps, got {self.stall_speed_mps} and {self.stall_command_mps}:"
                " otherwise every drive would be a stall"
            )
        return self

    def poses(self, car: VehicleCalibration) -> PoseGate:
        """Make the check of the car's poses."""
        bounds = MotionBounds.of_car(
            car.drive_limits, car.wheelbase_m, self.motion_margin, self.pose_noise_m, self.pose_noise_rad
        )
        return PoseGate(PoseCheck(bounds))

    def stall(self) -> StallGate:
        """Make the stall check."""
        limits = StallLimits(
            self.stall_command_mps, self.stall_speed_mps, self.stall_time_s, self.stall_sources
        )
        return StallGate(limits)

    def limits(self, room: RoomCalibration) -> ArmingLimits:
        """Make the limits of the arming.

        Raises:
            ConfigError: The margin keeps the car from being armed at the start of the room.
        """
        if (inside_m := edge_distance_m(room.start_pose[:2], room.fence_m)) < self.fence_margin_m:
            raise ConfigError(
                f"expected safety.fence_margin_m of at most {inside_m:.2f} m, the distance of the room's start_pose from its fence, got "
                f"{self.fence_margin_m:g} m (is it in cm?), by which the car could not be armed there"
            )
        return ArmingLimits(
            nodes=self.nodes,
            fence_m=room.fence_m,
            drivers=self.drivers,
            fence_margin_m=self.fence_margin_m,
            drive_age_s=self.drive_age_limit_s,
            image_age_s=self.image_age_limit_s,
            pose_age_s=self.pose_age_limit_s,
            status_age_s=self.status_age_limit_s,
            held_up_s=self.held_up_limit_s,
            speed_mps=self.max_speed_mps,
            steering_rad=self.max_steering_rad,
        )


class SafetyNode(Node):
    """Connects the arming state machine to the bus."""

    publications = ("/safety/drive", "/safety/state")
    tick_rate_hz = _TICK_RATE_HZ

    def __init__(
        self,
        limits: ArmingLimits,
        poses: PoseGate,
        stall: StallGate,
        hand: HandGate | None = None,
        clocks: ClockGate | None = None,
    ) -> None:
        self._arming = Arming(limits, hand or HandGate(), clocks or ClockGate(), (poses, stall))
        self._requests = ArmRequests(self._arming)
        self._clock_watch = ClockWatch()
        self._poses, self._stall = poses, stall
        self._topic_of = {f"/{driver}/drive": driver for driver in limits.drivers}
        self._stopped_ns = 0
        self._stated_ns = 0
        self._stated_armed: bool | None = None
        self._stops = 0
        self.subscriptions = (
            "/arm",
            "/teleop/state",
            "/clock/offset",
            "/camera/camera_info",
            "/vicon/car",
            "/motor/sent",
            "/motor/state",
            *self._topic_of,
            *map(status_topic, limits.nodes),
        )

    @classmethod
    def build(cls, config: SafetyConfig, context: NodeContext) -> SafetyNode:
        """Build the node."""
        hand = HandGate(config.teleop == "hold", config.teleop_age_limit_s)
        clocks = ClockGate(config.clock_offset_limit_s, config.clock_error_limit_s, config.clock_peers)
        limits = config.limits(load_calibration(RoomCalibration, config.room))
        poses = config.poses(load_calibration(VehicleCalibration, config.vehicle))
        return cls(limits, poses, config.stall(), hand, clocks)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Note a message. A command is forwarded if it may pass."""
        arming = self._arming
        self._watch_clocks(now)
        if topic in self._topic_of:
            return self._pass_on(self._topic_of[topic], message, info, now)
        if topic == "/teleop/state":
            return self._hand(message, info, now)
        if topic == "/arm":
            return self._obey(message, info, now)
        if topic == "/clock/offset":
            if not stamp_problem(stamp_age_s(stamp_of(message), now.real_ns), REQUEST_AGE_S):
                arming.clocks.heard(str(message.peer), float(message.offset_s), float(message.error_s), info)
        elif topic == "/camera/camera_info":
            arming.heard_camera(info)
        elif topic == "/vicon/car":
            self._see_car(message, info, now)
        elif topic == "/motor/sent":
            arming.peer = str(message.peer)
        elif topic == "/motor/state":
            arming.heard_motor(info)
            self._stall.motor(float(message.speed_mps), now.mono_ns)
        elif topic.startswith(STATUS_PREFIX):
            counters = dict(zip(message.counter_names, message.counter_values, strict=False))
            arming.heard_status(
                topic.removeprefix(STATUS_PREFIX),
                str(message.state),
                str(message.text),
                info,
                recorded=bool(counters.get(RECORDED)),
            )
        arming.check(now.mono_ns)
        return self._news(now)

    def tick(self, now: Now) -> list[Out]:
        """Run the checks, and send a stop at every tick while disarmed."""
        self._watch_clocks(now)
        self._arming.check(now.mono_ns)
        outs = self._news(now)
        if not self._arming.armed and now.mono_ns - self._stopped_ns >= _STOP_PERIOD_S * NS_PER_S:
            outs.append(self._stop(now))
        if now.mono_ns - self._stated_ns >= _STATE_PERIOD_S * NS_PER_S:
            outs.append(self._state(now))
        return outs

    def status(self) -> tuple[str, str]:
        """Report active while armed."""
        arming = self._arming
        return (
            (ACTIVE, f"armed by {arming.source}") if arming.armed else (READY, f"disarmed: {arming.reason}")
        )

    def counters(self) -> dict[str, float]:
        """Report how often it stopped the car."""
        return {"disarmed": self._stops, "impossible_poses": self._poses.count}

    def _watch_clocks(self, now: Now) -> None:
        if problem := self._clock_watch.problem(now):
            # Also while disarmed: requests from before are void.
            self._arming.disarm(problem, now.mono_ns)

    def _see_car(self, message: Any, info: MessageInfo, now: Now) -> None:
        limit_s = self._arming.limits.pose_age_s + AHEAD_LIMIT_S
        age_s, ahead_s = stamp_age_s(stamp_of(message), now.real_ns), self._arming.clocks.ahead_s(now.mono_ns)
        if problem := stamp_problem(age_s, limit_s, ahead_s):
            self._poses.refuse(f"the car's pose does not count: {problem}", info)
            return
        x_m, y_m = float(message.pose.position.x), float(message.pose.position.y)
        self._arming.heard_car(x_m, y_m, info)
        self._stall.pose(x_m, y_m, now.mono_ns)
        try:
            self._poses.heard(stamp_of(message), pose_matrix(message), info)
        except MessageError as error:
            self._poses.refuse(str(error), info)

    def _hand(self, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        speed, steering = float(message.speed_mps), float(message.steering_rad)
        passes = self._arming.heard_hand(
            str(message.mode), bool(message.estop), speed, steering, info, stamp_of(message), now
        )
        return self._news(now) + ([self._go(speed, steering, now.real_ns, now)] if passes else [])

    def _pass_on(self, driver: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        drive, capture_ns = message.drive, stamp_of(message)
        speed, steering = float(drive.speed), float(drive.steering_angle)
        if self._arming.heard_drive(speed, steering, capture_ns, info, now.mono_ns, now.real_ns, driver):
            return [self._go(speed, steering, capture_ns, now)]
        return self._news(now)

    def _go(self, speed_mps: float, steering_rad: float, stamp_ns: int, now: Now) -> Out:
        self._stall.commanded(speed_mps, now.mono_ns)
        return Out("/safety/drive", drive_message(speed_mps, steering_rad, stamp_ns))

    def _obey(self, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Execute a request to arm or disarm, and answer every repeat of it."""
        ask_id, source, stamp_ns = str(message.ask_id), str(message.source), stamp_of(message)
        asked_ns = min(asked_mono_ns(message, info), captured_mono_ns(stamp_ns, now), now.mono_ns)
        if message.arm:
            # The age itself is judged with the other conditions.
            age_s = min(0.0, stamp_age_s(stamp_ns, now.real_ns))
            problem = stamp_problem(age_s, 0.0, self._arming.clocks.ahead_s(now.mono_ns))
            refusal = f"the request does not count: {problem}" if problem else ""
            self._requests.arm(ask_id, source, asked_ns, now.mono_ns, refusal)
        else:
            self._requests.disarm(ask_id, f"disarmed by {source}: {message.reason}", asked_ns, now.mono_ns)
        self._arming.check(now.mono_ns)
        return self._news(now) or [self._state(now)]

    def _news(self, now: Now) -> list[Out]:
        """Messages to publish at once after the car was armed or disarmed."""
        if self._arming.armed is self._stated_armed:
            return []
        if self._stated_armed:
            self._stops += 1
            return [self._stop(now), self._state(now)]
        return [self._state(now)]

    def _stop(self, now: Now) -> Out:
        self._stopped_ns = now.mono_ns
        self._stall.stopped()
        return Out("/safety/drive", drive_message(0.0, 0.0, now.real_ns))

    def _state(self, now: Now) -> Out:
        self._stated_ns, self._stated_armed = now.mono_ns, self._arming.armed
        arming, answer = self._arming, self._requests.last
        message = types.SafetyState(
            header=header(now.real_ns),
            armed=arming.armed,
            stopping=not arming.armed,
            reason=arming.stopped_by,
            source=arming.source if arming.armed else "",
            answered_id=answer.ask_id,
            granted=answer.granted,
            answer=answer.text,
            command_age_s=arming.drive_age_s(now.mono_ns),
            pose_age_s=arming.pose_age_s(now.mono_ns),
        )
        return Out("/safety/state", message)


if __name__ == "__main__":
    raise SystemExit(run_node_main(SafetyConfig, SafetyNode.build))
