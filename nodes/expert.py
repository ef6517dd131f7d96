"""The expert node: drives the reference path with motion-capture poses, as a teacher for policies ("PID with VICON position").

The pose is old by the time the wheels have turned, so it is predicted along the last commanded arc at the measured speed. Two slow
integrators correct calibration errors of the steering trim and of the speed. Both are bounded and run only while the car is armed.

A policy that has only seen perfect driving cannot return to the path. So the node can add occasional disturbances, a steering offset
over a short distance, and then correct them. `/expert/state` has the steering without the disturbance.
"""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.geometry import wrap_angle, yaw_of
from advnerf_core.strict import StrictModel
from calibration.schema import RoomCalibration, VehicleCalibration, load_calibration
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import drive_message, finite_pose, header, stamp_ns, types
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main

_CAR, _STATE = "/vicon/car", "/safety/state"
_SPEED_BASE_S = 0.15
_JUMP_M = 0.5
_ARMED_AGE_S = 0.5
_SET_BACK_NS = NS_PER_S  # an older stamp than this was given by another time of the clock


class Disturbance(StrictModel):
    """Disturbances that the expert adds to its steering.

    Attributes:
        every_m: Distance from the end of a disturbance to the start of the next, drawn from this range [m].
        over_m: Length of a disturbance, drawn from this range [m].
        steering_rad: Largest steering offset. The offset is drawn between half and all of it, to either side [rad].
        within_m: Distance from the path beyond which no disturbance starts, and a running one ends [m].
        seed: Random seed.
    """

    every_m: tuple[float, float] = (1.5, 3.0)
    over_m: tuple[float, float] = (0.3, 0.6)
    steering_rad: float = Field(default=0.2, gt=0.0, le=0.4)
    within_m: float = Field(default=0.25, gt=0.0)
    seed: int = 0

    @model_validator(mode="after")
    def _ranges(self) -> Disturbance:
        for name in ("every_m", "over_m"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"expected {name} as two rising distances > 0 m, got [{low}, {high}]")
        return self


class ExpertNodeConfig(StrictModel):
    """Configuration of the expert node.

    Attributes:
        room: Room calibration file with the path.
        vehicle: Vehicle calibration file with wheelbase and limits.
        speed_mps: Driving speed [m/s].
        delay_s: Delay from the capture of a pose to the resulting wheel angle [s].
        stiffness_1pm: Natural frequency of the return to the path, per metre driven [1/m].
        integral_radpm2: Integral gain: steering trim per metre of offset and metre driven [rad/m^2].
        trim_limit_rad: Bound of the steering trim [rad].
        speed_integral_1ps: Integral gain of the speed correction [1/s].
        speed_trim_limit: Bound of the speed correction, as a fraction of the speed.
        rate_hz: Rate of commands [Hz].
        max_age_s: Largest age of a pose since its capture [s].
        disturb: Disturbances; None drives without them.
    """

    room: Path
    vehicle: Path
    speed_mps: float = Field(default=0.8, gt=0.0, le=2.0)
    delay_s: float = Field(default=0.1, ge=0.0, le=0.5)
    stiffness_1pm: float = Field(default=2.0, gt=0.0, le=6.0)
    integral_radpm2: float = Field(default=0.02, ge=0.0)
    trim_limit_rad: float = Field(default=0.05, ge=0.0, le=0.2)
    speed_integral_1ps: float = Field(default=0.5, ge=0.0)
    speed_trim_limit: float = Field(default=0.1, ge=0.0, le=0.3)
    rate_hz: float = Field(default=20.0, gt=0.0, le=100.0)
    max_age_s: float = Field(default=0.1, gt=0.0, le=0.2)
    disturb: Disturbance | None = None


class _Disturber:
    """Steering offsets as a function of the driven distance."""

    def __init__(self, config: Disturbance) -> None:
        self._config = config
        self._rng = np.random.default_rng(config.seed)
        self._begin_m = float(self._rng.uniform(*config.every_m))
        self._end_m = 0.0
        self._offset_rad = 0.0

    def at(self, driven_m: float, cte_m: float) -> float:
        """Steering offset [rad] at a driven distance [m] and cross-track error [m]."""
        config = self._config
        if self._offset_rad == 0.0 and driven_m >= self._begin_m and abs(cte_m) <= config.within_m:
            self._end_m = driven_m + float(self._rng.uniform(*config.over_m))
            side = 1.0 if self._rng.random() < 0.5 else -1.0
            self._offset_rad = side * config.steering_rad * float(self._rng.uniform(0.5, 1.0))
        elif self._offset_rad and (driven_m >= self._end_m or abs(cte_m) > config.within_m):
            self._offset_rad = 0.0
            self._begin_m = driven_m + float(self._rng.uniform(*config.every_m))
        return self._offset_rad


class ExpertNode(Node):
    """Turns poses into drive commands."""

    subscriptions = (_CAR, _STATE)
    publications = ("/expert/drive", "/expert/state")
    tick_rate_hz = 10.0

    def __init__(self, expert: Expert, config: ExpertNodeConfig) -> None:
        self._expert, self._config = expert, config
        self._disturber = None if config.disturb is None else _Disturber(config.disturb)
        self._track: deque[tuple[int, float, float]] = deque()
        self._armed_ns: int | None = None
        self._commanded_ns = 0
        self._driven_m, self._s_m = 0.0, 0.0
        self._steering_rad = self._trim_rad = self._speed_trim = 0.0
        self._cte_m = 0.0
        self._stale = 0
        self._now_ns = 0

    @classmethod
    def build(cls, config: ExpertNodeConfig, context: NodeContext) -> ExpertNode:
        """Build the node."""
        car = load_calibration(VehicleCalibration, config.vehicle)
        settings = ExpertConfig(
            wheelbase_m=car.wheelbase_m,
            speed_mps=config.speed_mps,
            delay_s=0.0,
            stiffness_1pm=config.stiffness_1pm,
            steering_limits_rad=(car.limits.steering_min_rad, car.limits.steering_max_rad),
        )
        return cls(Expert(load_calibration(RoomCalibration, config.room).reference_path, settings), config)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Compute a command from a pose, unless the pose is too old, invalid, or earlier than the next command is due."""
        self._now_ns = now.mono_ns
        if topic == _STATE:
            self._armed_ns = info.publish_mono_ns if message.armed else None
            return []
        capture_ns = stamp_ns(message)
        if (
            T := finite_pose(message)
        ) is None or now.real_ns - capture_ns > self._config.max_age_s * NS_PER_S:
            self._stale += 1
            return []
        x_m, y_m, yaw_rad = float(T[0, 3]), float(T[1, 3]), yaw_of(T)
        if self._track and capture_ns < self._track[-1][0] - _SET_BACK_NS:
            self._track.clear()  # the clock was set back: what was measured before is not comparable
        if self._track and capture_ns <= self._track[-1][0]:
            return []
        speed_mps = self._follow(capture_ns, x_m, y_m, yaw_rad)
        # A tenth of a period early counts as on time, because poses arrive on another grid.
        if now.mono_ns - self._commanded_ns < 0.9 / self._config.rate_hz * NS_PER_S:
            return []
        since_s = min(0.1, (now.mono_ns - self._commanded_ns) / NS_PER_S)
        self._commanded_ns = now.mono_ns
        return self._command(capture_ns, (x_m, y_m, yaw_rad), speed_mps, since_s)

    def tick(self, now: Now) -> list[Out]:
        """Note the time, so that the status shows when poses stop."""
        self._now_ns = now.mono_ns
        return []

    def status(self) -> tuple[str, str]:
        """Report active while it sends commands."""
        if self._now_ns - self._commanded_ns > NS_PER_S or not self._commanded_ns:
            return READY, f"no fresh pose of the car on {_CAR}"
        laps = self._driven_m / self._expert.path.length_m
        return (
            ACTIVE,
            f"{100 * self._cte_m:+.0f} cm from the path, {self._driven_m:.1f} m driven, {laps:.1f} laps",
        )

    def counters(self) -> dict[str, float]:
        """Report unusable poses and the current trims."""
        return {"stale_poses": self._stale, "trim_rad": self._trim_rad, "speed_trim": self._speed_trim}

    def _armed(self) -> bool:
        return self._armed_ns is not None and self._now_ns - self._armed_ns < _ARMED_AGE_S * NS_PER_S

    def _follow(self, capture_ns: int, x_m: float, y_m: float, yaw_rad: float) -> float:
        """Update and return the measured speed [m/s], forward positive. After a jump of the car, the estimate restarts."""
        track = self._track
        if track and math.hypot(x_m - track[-1][1], y_m - track[-1][2]) > _JUMP_M:
            track.clear()
        track.append((capture_ns, x_m, y_m))
        while len(track) > 2 and capture_ns - track[1][0] >= _SPEED_BASE_S * NS_PER_S:
            track.popleft()
        first_ns, first_x, first_y = track[0]
        span_s = (capture_ns - first_ns) / NS_PER_S
        if span_s < 0.5 * _SPEED_BASE_S:
            return 0.0
        along = (x_m - first_x) * math.cos(yaw_rad) + (y_m - first_y) * math.sin(yaw_rad)
        return along / span_s

    def _command(
        self, capture_ns: int, pose: tuple[float, float, float], speed_mps: float, since_s: float
    ) -> list[Out]:
        config = self._config
        at = self._expert.path.project(np.array(pose[:2]))
        self._cte_m = cte_m = float(at.cte_m)
        armed = self._armed()
        if armed:
            moved_m = float(at.s_m) - self._s_m
            length_m = self._expert.path.length_m
            moved_m -= length_m * round(moved_m / length_m)
            self._driven_m += moved_m if 0.0 < moved_m < _JUMP_M else 0.0
        self._s_m = float(at.s_m)
        disturbance = self._disturber.at(self._driven_m, cte_m) if armed and self._disturber else 0.0
        wanted = float(self._expert.steer(*self._ahead(pose, speed_mps))) + self._trim_rad
        if armed and not disturbance:
            self._integrate(cte_m, speed_mps, since_s)
        low, high = self._expert.config.steering_limits_rad
        steering = min(max(wanted + disturbance, low), high)
        self._steering_rad = steering
        speed = config.speed_mps * (1.0 + self._speed_trim)
        state = types.ExpertState(
            header=header(capture_ns, "world"),
            cte_m=cte_m,
            heading_error_rad=float(wrap_angle(pose[2] - float(at.heading_rad))),
            s_m=self._s_m,
            driven_m=self._driven_m,
            speed_mps=speed_mps,
            steering_rad=wanted,
            disturbance_rad=steering - wanted if disturbance else 0.0,
        )
        return [Out("/expert/drive", drive_message(speed, steering, capture_ns)), Out("/expert/state", state)]

    def _ahead(self, pose: tuple[float, float, float], speed_mps: float) -> tuple[float, float, float]:
        """Predict the pose after the delay, on the arc of the last command."""
        x_m, y_m, yaw_rad = pose
        distance_m = max(speed_mps, 0.0) * self._config.delay_s
        turn_rad = distance_m * math.tan(self._steering_rad) / self._expert.config.wheelbase_m
        chord_rad = yaw_rad + 0.5 * turn_rad
        chord_m = distance_m * float(np.sinc(0.5 * turn_rad / math.pi))
        return x_m + chord_m * math.cos(chord_rad), y_m + chord_m * math.sin(chord_rad), yaw_rad + turn_rad

    def _integrate(self, cte_m: float, speed_mps: float, since_s: float) -> None:
        config = self._config
        moved_m = max(speed_mps, 0.0) * since_s
        trim = self._trim_rad - config.integral_radpm2 * cte_m * moved_m
        self._trim_rad = min(max(trim, -config.trim_limit_rad), config.trim_limit_rad)
        if speed_mps > 0.5 * config.speed_mps:  # not while the car still accelerates
            error = (config.speed_mps - speed_mps) / config.speed_mps
            speed_trim = self._speed_trim + config.speed_integral_1ps * error * since_s
            self._speed_trim = min(max(speed_trim, -config.speed_trim_limit), config.speed_trim_limit)


if __name__ == "__main__":
    raise SystemExit(run_node_main(ExpertNodeConfig, ExpertNode.build))
