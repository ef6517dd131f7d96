"""The calibration drive for ``advnerf car calibrate vehicle``. It replaces the policy: ``--set policy.module=nodes.calibration_drive``.

The car drives circles to both sides, straight runs and wide curves at two speeds, then steps of steering and speed. This takes up to
a minute. With a wheelbase of up to 0.35 m and a steering gain that is right to 10 %, the car stays within 6.5 m behind its start, 3.5 m
in front, 4 m to its right and 4.5 m to its left. The car drives only while the safety node has armed it, within fence and limits like
any policy. After a stop, the interrupted part starts again; the operator may carry the car back first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from calibration.schema import VehicleCalibration, load_calibration
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import drive_message, stamp_ns
from nodes.runtime.node import MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main

STATE, DRIVE = "/safety/state", "/policy/drive"
# Keys of the policy node that a launch file may give, and that say nothing about this drive.
UNREAD_KEYS = ("policy", "sha256", "planned_speed", "max_age_s", "recorded", "goal")
STRAIGHT_SLOW_S, STRAIGHT_FAST_S = 1.8, 1.4
STEPS = 6


@dataclass(frozen=True)
class Manoeuvre:
    """A command that is held for some time.

    Attributes:
        steering_rad: Wheel angle, left positive [rad].
    """

    duration_s: float
    steering_rad: float
    speed_mps: float


class CalibrationDriveConfig(StrictModel):
    """Configuration of the calibration drive. `UNREAD_KEYS` are ignored, so that this node can replace the policy node.

    Attributes:
        vehicle: Vehicle calibration file, whose wheelbase gives the length of a half circle.
        image_topic: Topic of the images, raw or compressed; each is answered with a command.
        slow_mps: The lower speed [m/s].
        fast_mps: The higher speed [m/s].
        speed_mps: Highest speed; if it is below ``fast_mps``, both speeds are lowered in proportion [m/s]. None for no other limit.
        tight_rad: Wheel angle of the circles [rad].
        wide_rad: Wheel angle of the wide curves [rad].
    """

    vehicle: Path
    image_topic: str = "/compositor/image"
    slow_mps: float = Field(default=0.5, gt=0.0)
    fast_mps: float = Field(default=0.9, gt=0.0)
    speed_mps: float | None = Field(default=None, gt=0.0)
    tight_rad: float = Field(default=0.25, gt=0.05, lt=0.6)
    wide_rad: float = Field(default=0.12, gt=0.02, lt=0.6)

    @model_validator(mode="before")
    @classmethod
    def _without_the_policy(cls, data: Any) -> Any:
        return {key: data[key] for key in data if key not in UNREAD_KEYS} if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _apart(self) -> CalibrationDriveConfig:
        if self.fast_mps < 1.3 * self.slow_mps or self.tight_rad < 1.3 * self.wide_rad:
            raise ValueError(
                "expected fast_mps and tight_rad at least 1.3 times slow_mps and wide_rad, which the fits need; increase them"
            )
        return self


def program(config: CalibrationDriveConfig, wheelbase_m: float) -> list[Manoeuvre]:
    """Parts of the drive: a loop to the left, a faster loop to the right, then two rows of steps with half circles between them.

    Args:
        wheelbase_m: Distance between the axles [m].
    """
    share = min(1.0, (config.speed_mps or config.fast_mps) / config.fast_mps)
    slow, fast = share * config.slow_mps, share * config.fast_mps
    tight, wide = config.tight_rad, config.wide_rad

    def half_circle(steering: float, speed: float) -> Manoeuvre:
        return Manoeuvre(math.pi * wheelbase_m / math.tan(abs(steering)) / speed, steering, speed)

    parts = []
    for speed, hold_s, turn in ((slow, STRAIGHT_SLOW_S, tight), (fast, STRAIGHT_FAST_S, -tight)):
        parts += [Manoeuvre(hold_s, 0.0, speed), half_circle(turn, speed)]
        parts += [Manoeuvre(hold_s, wide, speed), Manoeuvre(hold_s, -wide, speed), half_circle(turn, speed)]
    for row in (0, 1):
        side = 1.0 if row else -1.0
        for k in range(STEPS):
            speed = (slow, fast)[(k // 2 + row) % 2]
            parts.append(Manoeuvre(0.46 + 0.05 * k, side * (-1.0) ** k * tight * (0.96 - 0.08 * k), speed))
        parts.append(half_circle(tight, fast))
    return parts


class CalibrationDrive(Node):
    """Answers every image with the current command of the drive."""

    publications = (DRIVE,)
    blind = True

    def __init__(self, parts: Sequence[Manoeuvre], image_topic: str = "/compositor/image") -> None:
        self.subscriptions = (image_topic, STATE)
        self._parts = parts
        self._index, self._since_ns = 0, 0
        self._armed = False

    @classmethod
    def build(cls, config: CalibrationDriveConfig, context: NodeContext) -> CalibrationDrive:
        """Build the node.

        Raises:
            calibration.schema.CalibrationError: There is no such vehicle file, or it is wrong.
        """
        car = load_calibration(VehicleCalibration, config.vehicle)
        return cls(program(config, car.wheelbase_m), config.image_topic)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Note the state of the safety node, or answer an image."""
        if topic == STATE:
            armed = bool(message.armed) and not bool(message.stopping)
            if armed and not self._armed:
                self._since_ns = now.mono_ns
            self._armed = armed
            return []
        speed, steering = self._due(now.mono_ns)
        return [Out(DRIVE, drive_message(speed, steering, stamp_ns(message)))]

    def status(self) -> tuple[str, str]:
        """Report the current part."""
        if self._index == len(self._parts):
            return "ready", "done, stop the recording"
        where = f"part {self._index + 1} of {len(self._parts)}"
        return ("active", where) if self._armed else ("ready", f"{where}, waiting for arming")

    def _due(self, mono_ns: int) -> tuple[float, float]:
        """Current speed [m/s] and steering [rad]. Without arming, the car stands and the time of the part does not advance."""
        if not self._armed:
            return 0.0, 0.0
        while self._index < len(self._parts):
            part = self._parts[self._index]
            end_ns = self._since_ns + round(part.duration_s * NS_PER_S)
            if mono_ns < end_ns:
                return part.speed_mps, part.steering_rad
            self._index, self._since_ns = self._index + 1, end_ns
        return 0.0, 0.0


if __name__ == "__main__":
    raise SystemExit(run_node_main(CalibrationDriveConfig, CalibrationDrive.build))
