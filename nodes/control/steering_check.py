"""The check that the front wheels turn. Pure: time and poses come as arguments.

The servo sends no acknowledgement, and stock firmware may drop its commands silently (hardware/emulators/vesc_firmware.py). So a car
that cannot steer could be armed. Before the first arming, the wheels are therefore turned left, right and straight while the motor
stays off. Either motion capture confirms it, when the car is pushed by hand in each position and its path curves as commanded, or
the operator does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from nodes.runtime.clock import NS_PER_S

# Time after which the servo (50 Hz, limited slew rate) has reached its position. Earlier motion is ignored [s].
_SETTLE_S = 0.5
_LEFT, _RIGHT = 0, 1


# Noise of a standing car's poses, at 100 Hz, must not add up to a distance [m].
_STEP_M = 0.03


@dataclass(frozen=True)
class CheckSettings:
    """Settings of the check.

    Attributes:
        wheelbase_m: Distance between the axles [m].
        angle_rad: Front wheel angle to each side [rad].
        hold_s: Time for which each angle is held [s].
        push_m: Shortest distance that the car must be pushed to measure its curvature [m].
        agreement: Largest relative deviation of the measured from the commanded curvature.
        answer_s: Time for the operator's answer [s].
    """

    wheelbase_m: float
    angle_rad: float = 0.2
    hold_s: float = 4.0
    push_m: float = 0.15
    agreement: float = 0.5
    answer_s: float = 60.0


@dataclass
class _Arc:
    """Motion of the car while the wheels were turned to one side."""

    forward_m: float = 0.0
    driven_m: float = 0.0
    turned_rad: float = 0.0


class SteeringCheck:
    """State machine of the steering check.

    Attributes:
        passed: Whether motion capture or the operator confirmed that the wheels turn.
        text: State of the check, as text for the operator.
    """

    def __init__(self, settings: CheckSettings) -> None:
        self._settings = settings
        self._began_ns: int | None = None
        self._arcs = (_Arc(), _Arc())
        self._last: tuple[float, float, float] | None = None
        self.passed = False
        self.text = "steering was not checked: advnerf car motor check-steering"

    @property
    def showing(self) -> bool:
        """Whether the check is turning the wheels or waiting for an answer."""
        return self._began_ns is not None

    def awaits_answer(self, mono_ns: int) -> bool:
        """Whether the wheels were turned to both sides and the operator may answer."""
        return self.showing and self._side(mono_ns) is None

    def start(self, mono_ns: int) -> None:
        """Start the check. An earlier result is discarded."""
        self._began_ns, self.passed, self._last = mono_ns, False, None
        self._arcs = (_Arc(), _Arc())
        self.text = "steering check: wheels left, then right; push the car half a metre each time, or watch and confirm"

    def forget(self, reason: str) -> None:
        """Discard the result, for example because the controller was replaced."""
        self._began_ns, self.passed = None, False
        self.text = f"{reason}: steering must be checked again: advnerf car motor check-steering"

    def steering_rad(self, mono_ns: int) -> float | None:
        """Front wheel angle to command now [rad]; None if the check is not turning the wheels."""
        side = self._side(mono_ns)
        if side is None:
            return 0.0 if self.showing else None
        return self._settings.angle_rad if side == _LEFT else -self._settings.angle_rad

    def pose(self, x_m: float, y_m: float, yaw_rad: float, mono_ns: int) -> None:
        """Note a pose of the car. Poses that are not finite are ignored."""
        if not (self.showing and all(map(math.isfinite, (x_m, y_m, yaw_rad)))):
            return
        side, last, now = self._side(mono_ns), self._last, (x_m, y_m, yaw_rad)
        if side is None or last is None or not self._settled(mono_ns):
            self._last = now
            return
        dx, dy = x_m - last[0], y_m - last[1]
        if math.hypot(dx, dy) < _STEP_M:
            return
        self._last = now
        middle = last[2] + 0.5 * math.remainder(yaw_rad - last[2], 2.0 * math.pi)
        forward = dx * math.cos(middle) + dy * math.sin(middle)
        arc = self._arcs[side]
        arc.forward_m += forward
        arc.driven_m += abs(forward)
        # Rolling backwards reverses the turn.
        arc.turned_rad += math.copysign(1.0, forward) * math.remainder(yaw_rad - last[2], 2.0 * math.pi)

    def tick(self, mono_ns: int) -> None:
        """Advance the time: evaluate the measured motion, or stop waiting."""
        if self._began_ns is None or self._side(mono_ns) is not None:
            return
        if all(abs(arc.forward_m) >= self._settings.push_m for arc in self._arcs):
            self._judge()
        elif (mono_ns - self._began_ns) / NS_PER_S > 2.0 * self._settings.hold_s + self._settings.answer_s:
            self._end(False, "steering check: no answer; start it again: advnerf car motor check-steering")
        else:
            self.text = "steering check: did the front wheels turn left, then right? confirm or deny"

    def answer(self, turned: bool, source: str, mono_ns: int) -> None:
        """Note the operator's answer whether the wheels turned. It counts only after both sides were shown."""
        if not self.awaits_answer(mono_ns):
            return
        if turned:
            self._end(True, f"steering confirmed by {source}")
        else:
            self._end(False, f"steering denied by {source}: {_CAUSES}")

    def _judge(self) -> None:
        for arc, sign, name in zip(self._arcs, (1.0, -1.0), ("left", "right"), strict=True):
            told = sign * math.tan(self._settings.angle_rad) / self._settings.wheelbase_m
            driven = arc.turned_rad / arc.driven_m
            if abs(driven - told) > self._settings.agreement * abs(told):
                self._end(
                    False,
                    f"with wheels turned {name}, expected a curvature of {told:+.2f} 1/m, measured {driven:+.2f} 1/m; check: {_CAUSES}",
                )
                return
        self._end(True, "steering seen by motion capture")

    def _end(self, passed: bool, text: str) -> None:
        self._began_ns, self.passed, self.text = None, passed, text

    def _side(self, mono_ns: int) -> int | None:
        if self._began_ns is None:
            return None
        step = int((mono_ns - self._began_ns) / NS_PER_S / self._settings.hold_s)
        return step if step in (_LEFT, _RIGHT) else None

    def _settled(self, mono_ns: int) -> bool:
        assert self._began_ns is not None
        return (mono_ns - self._began_ns) / NS_PER_S % self._settings.hold_s >= _SETTLE_S


_CAUSES = "servo output off in the controller's firmware or application settings, servo unplugged, or gains of another car"
