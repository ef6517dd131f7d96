"""Detects a car that does not move although it is commanded to: a wall, a jammed wheel, a motor without power. Pure.

Two measurements are used: motion capture (whether the car moves) and the motor controller's rpm (whether the motor turns). A car
against a wall may spin its wheels, and a disconnected motor stands still while the car rolls. So either one at rest is a stall.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from nodes.runtime.clock import NS_PER_S

MOCAP, ERPM = "mocap", "erpm"
_WORDS = {MOCAP: "motion capture measures", ERPM: "the motor controller measures"}
# Time over which motion capture gives the speed, so that 1 mm of noise causes an error of 10 mm/s [s].
_BASE_S = 0.1
# Largest age of a measurement. Another check reports a missing one [s].
_FRESH_S = 0.3


@dataclass(frozen=True)
class StallLimits:
    """Definition of a stall.

    Attributes:
        command_mps: Smallest commanded speed that is checked [m/s].
        measured_mps: Measured speed below which the car is at rest [m/s].
        time_s: Duration of a stall: commanded to move and measured at rest [s].
        sources: Measurements to use.
    """

    command_mps: float = 0.3
    measured_mps: float = 0.1
    time_s: float = 1.0
    sources: tuple[str, ...] = (MOCAP, ERPM)


@dataclass
class StallGate:
    """Collects commands and measurements.

    Attributes:
        limits: Definition of a stall.
    """

    limits: StallLimits
    _commanded_mps: float = 0.0
    _commanded_ns: int | None = None
    _track: deque[tuple[int, float, float]] = field(default_factory=deque)
    _moved_ns: dict[str, int] = field(default_factory=dict)
    _heard: dict[str, tuple[int, float]] = field(default_factory=dict)

    def commanded(self, speed_mps: float, mono_ns: int) -> None:
        """Note a command to drive [m/s]."""
        self._commanded_mps = speed_mps
        if abs(speed_mps) < self.limits.command_mps:
            self._commanded_ns = None
        elif self._commanded_ns is None:
            self._commanded_ns = mono_ns

    def stopped(self) -> None:
        """Note a command to stop."""
        self._commanded_ns = None

    def pose(self, x_m: float, y_m: float, mono_ns: int) -> None:
        """Note a position of the car from motion capture [m]."""
        if self._track and mono_ns - self._track[-1][0] > _FRESH_S * NS_PER_S:
            self._track.clear()
        self._track.append((mono_ns, x_m, y_m))
        while len(self._track) > 2 and mono_ns - self._track[1][0] >= _BASE_S * NS_PER_S:
            self._track.popleft()
        first_ns, first_x_m, first_y_m = self._track[0]
        base_s = (mono_ns - first_ns) / NS_PER_S
        if base_s >= _BASE_S:
            self._measured(MOCAP, math.hypot(x_m - first_x_m, y_m - first_y_m) / base_s, mono_ns)

    def motor(self, speed_mps: float, mono_ns: int) -> None:
        """Note the speed of the motor from the motor controller, as a speed of the car [m/s]."""
        self._measured(ERPM, speed_mps, mono_ns)

    def problem(self, mono_ns: int) -> str:
        """Describe the stall; empty if the car is not stalled."""
        limits = self.limits
        if self._commanded_ns is None or mono_ns - self._commanded_ns < limits.time_s * NS_PER_S:
            return ""
        rest_s = max((self._rest_s(name, mono_ns) for name in limits.sources), default=0.0)
        if rest_s < limits.time_s:
            return ""
        return (
            f"stalled for {rest_s:.1f} s: commanded {self._commanded_mps:.2f} m/s, {self._finding(mono_ns)}"
        )

    def _measured(self, name: str, speed_mps: float, mono_ns: int) -> None:
        # Everything except rest counts as motion, including NaN. Another check reports a broken measurement.
        if not self._fresh(name, mono_ns) or not abs(speed_mps) < self.limits.measured_mps:
            self._moved_ns[name] = mono_ns
        self._heard[name] = (mono_ns, speed_mps)

    def _fresh(self, name: str, mono_ns: int) -> bool:
        return name in self._heard and mono_ns - self._heard[name][0] <= _FRESH_S * NS_PER_S

    def _rest_s(self, name: str, mono_ns: int) -> float:
        """Time for which a source has measured the car at rest while it was commanded to move [s]."""
        if self._commanded_ns is None or not self._fresh(name, mono_ns):
            return 0.0
        return (mono_ns - max(self._moved_ns[name], self._commanded_ns)) / NS_PER_S

    def _finding(self, mono_ns: int) -> str:
        speeds = {name: self._heard[name][1] for name in self.limits.sources if self._fresh(name, mono_ns)}
        numbers = ", ".join(f"{_WORDS[name]} {speed_mps:.2f} m/s" for name, speed_mps in speeds.items())
        moving = {name for name, speed_mps in speeds.items() if abs(speed_mps) >= self.limits.measured_mps}
        if moving == {ERPM}:
            return f"the wheels spin but the car does not move ({numbers})"
        if moving == {MOCAP}:
            return f"the motor does not turn although the car moves ({numbers})"
        return f"the car does not move ({numbers})"
