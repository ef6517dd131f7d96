"""Checks whether consecutive poses are a motion that the car can make. Pure: stamps come with the poses.

From one pose to the next, the car may travel at most ``speed * dt`` along its axis and a small fraction of that sideways or upward,
and turn by at most ``turn rate * dt``, each plus an allowance for measurement noise. A pose beyond these bounds does not belong to
this car: the stream, the marker set or the subject is wrong.

``dt`` is the longest gap between stamps in the last 0.1 s, not only the gap before the pose. Stamps are taken on receipt. If a
datagram is delayed in the network or in a busy computer, the next ones follow too closely, and the car seems to jump. Such a jump
always follows a gap of the same length, so this definition of ``dt`` allows it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hardware.motor.limits import DriveLimits
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.wire import MessageInfo

# Gaps this recent are considered: a late datagram and those behind it arrive within this time [s].
_GAP_WINDOW_S = 0.1
# A pose is also compared with one this much older, so that small steps cannot add up [s].
_BASE_S = 0.25
_FARTHEST_M = 1e4


@dataclass(frozen=True)
class MotionBounds:
    """Limits of the car's motion and noise of its measurement.

    Attributes:
        forward_mps: Largest forward speed [m/s].
        backward_mps: Largest backward speed [m/s].
        turn_radps: Largest turn rate [rad/s].
        sideways_share: Largest sideways and vertical motion as a fraction of the fastest motion: the sine of the largest slip angle.
        reach_m: Largest distance of the tracked point from the rear axle [m]. Turning moves the point sideways.
        noise_m: Largest noise between two poses [m].
        noise_rad: Largest noise between two headings [rad].
        longest_gap_s: Longest gap in the stream across which motion is checked [s].
    """

    forward_mps: float
    backward_mps: float
    turn_radps: float
    sideways_share: float = 0.25
    reach_m: float = 0.25
    noise_m: float = 0.005
    noise_rad: float = 0.01
    longest_gap_s: float = 0.25

    @classmethod
    def of_car(
        cls, limits: DriveLimits, wheelbase_m: float, margin: float, noise_m: float, noise_rad: float
    ) -> MotionBounds:
        """Make bounds from a vehicle calibration. ``margin`` is the factor by which the car may exceed its commanded speed."""
        fastest_mps = max(limits.speed_max_mps, -limits.speed_min_mps)
        sharpest_rad = max(limits.steering_max_rad, -limits.steering_min_rad)
        turn_radps = fastest_mps * math.tan(sharpest_rad) / wheelbase_m
        # A backward limit of 0 means that no backward motion is commanded. A stopped car still rolls back a little.
        backward_mps = max(-limits.speed_min_mps, 0.1 * limits.speed_max_mps)
        return cls(
            margin * limits.speed_max_mps,
            margin * backward_mps,
            margin * turn_radps,
            reach_m=wheelbase_m,
            noise_m=noise_m,
            noise_rad=noise_rad,
        )


@dataclass
class PoseCheck:
    """Checks poses in their order of arrival.

    Attributes:
        bounds: Limits of the motion.
    """

    bounds: MotionBounds
    _poses: deque[tuple[int, NDArray[np.float64]]] = field(default_factory=deque)
    _gaps: deque[tuple[int, float]] = field(default_factory=deque)

    def judge(self, stamp_ns: int, T_world_from_car: NDArray[np.float64]) -> str:
        """Return why a pose ``[4, 4]`` with its capture stamp [ns] is impossible; empty if it is possible.

        After an impossible pose, the next poses are compared with that pose.
        """
        T = np.asarray(T_world_from_car, dtype=np.float64)
        if not (np.abs(T) < _FARTHEST_M).all():  # also false for NaN
            return f"expected a pose of the car within {_FARTHEST_M:g} m, got {T[:3, 3].tolist()}"
        if not self._poses:
            self._begin_after_a_gap(stamp_ns, T)
            return ""
        last_ns, last = self._poses[-1]
        gap_s = (stamp_ns - last_ns) / NS_PER_S
        if gap_s > self.bounds.longest_gap_s:
            self._begin_after_a_gap(stamp_ns, T)
            return ""
        if gap_s < -_GAP_WINDOW_S:
            self._begin(stamp_ns, T)
            return f"the stamps of the car's poses went back by {-gap_s:.2f} s"
        allowed_s = self._allowed_s(stamp_ns, gap_s)
        problem = self._impossible(last, T, allowed_s, gap_s)
        if not problem:
            base_ns, base = self._poses[0]
            base_s = (stamp_ns - base_ns) / NS_PER_S
            problem = self._impossible(base, T, base_s + allowed_s, base_s)
        if problem:
            self._begin(stamp_ns, T)
            return problem
        self._poses.append((stamp_ns, T))
        while stamp_ns - self._poses[1][0] >= _BASE_S * NS_PER_S:
            self._poses.popleft()
        return ""

    def _begin(self, stamp_ns: int, T: NDArray[np.float64]) -> None:
        self._poses.clear()
        self._gaps.clear()
        self._poses.append((stamp_ns, T))

    def _begin_after_a_gap(self, stamp_ns: int, T: NDArray[np.float64]) -> None:
        """Begin with the first pose of a stream, or with the first after a long gap: poses that were delayed with it follow too closely."""
        self._begin(stamp_ns, T)
        self._gaps.append((stamp_ns, self.bounds.longest_gap_s))

    def _allowed_s(self, stamp_ns: int, gap_s: float) -> float:
        self._gaps.append((stamp_ns, gap_s))
        while stamp_ns - self._gaps[0][0] > _GAP_WINDOW_S * NS_PER_S:
            self._gaps.popleft()
        return max(0.0, *(gap for _, gap in self._gaps))

    def _impossible(
        self, A: NDArray[np.float64], B: NDArray[np.float64], allowed_s: float, dt_s: float
    ) -> str:
        bounds = self.bounds
        turned_rad = _angle(A[:3, :3].T @ B[:3, :3])
        if turned_rad > bounds.turn_radps * allowed_s + bounds.noise_rad:
            limit = bounds.turn_radps * allowed_s + bounds.noise_rad
            return f"the car's pose turned by {turned_rad:.2f} rad in {dt_s:.3f} s; the car can turn by {limit:.2f} rad"
        # In the frame of the mean heading, because the chord of an arc is parallel to it.
        axis = A[:3, 0] + B[:3, 0]
        step = B[:3, 3] - A[:3, 3]
        along_m = float(step @ axis) / max(float(np.linalg.norm(axis)), 1e-9)
        across_m = math.sqrt(max(float(step @ step) - along_m * along_m, 0.0))
        speed_mps = bounds.forward_mps if along_m > 0.0 else bounds.backward_mps
        off_axle_m = bounds.reach_m * turned_rad
        if abs(along_m) > (limit := speed_mps * allowed_s + bounds.noise_m + off_axle_m):
            way = "forward" if along_m > 0.0 else "backward"
            return f"the car's pose jumped {abs(along_m):.3f} m {way} in {dt_s:.3f} s; the car can move {limit:.3f} m"
        sideways_mps = bounds.sideways_share * max(bounds.forward_mps, bounds.backward_mps)
        if across_m > (limit := sideways_mps * allowed_s + bounds.noise_m + off_axle_m):
            return f"the car's pose jumped {across_m:.3f} m sideways in {dt_s:.3f} s; the car can slip {limit:.3f} m"
        return ""


def _angle(R: NDArray[np.float64]) -> float:
    # From the skew part for small angles, where the trace is not accurate.
    skew = 0.5 * math.sqrt((R[2, 1] - R[1, 2]) ** 2 + (R[0, 2] - R[2, 0]) ** 2 + (R[1, 0] - R[0, 1]) ** 2)
    return math.atan2(skew, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))


@dataclass
class PoseGate:
    """Allows motion only while the car's poses are possible.

    A disarmed car may be carried or pushed. It only has to rest before arming.

    Attributes:
        check: The check of the poses.
        rest_s: Time without an impossible pose after which the car may move [s].
        count: Number of impossible poses.
    """

    check: PoseCheck
    rest_s: float = 0.5
    count: int = 0
    _text: str = ""
    _seen_ns: int = 0

    def heard(self, stamp_ns: int, T_world_from_car: NDArray[np.float64], info: MessageInfo) -> None:
        """Note a pose ``[4, 4]`` of the car."""
        if text := self.check.judge(stamp_ns, T_world_from_car):
            self.refuse(text, info)

    def refuse(self, text: str, info: MessageInfo) -> None:
        """Note a message that is not a valid pose."""
        self._text, self._seen_ns = text, info.fresh_mono_ns
        self.count += 1

    def problem(self, mono_ns: int) -> str:
        """Return why the car may not move; empty if it may."""
        return self._text if self._text and mono_ns - self._seen_ns < self.rest_s * NS_PER_S else ""
