"""When the car may move: checks, and an arming that any failed check ends until somebody arms again.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from nodes.runtime.clock import NS_PER_S
from nodes.runtime.wire import MessageInfo

OPERATOR = "operator"
TWIN_PEER = "TWIN"
_ALIVE_STATES = ("ready", "active")


@dataclass(frozen=True)
class ArmingLimits:
    """Numbers of the checks.

    Attributes:
        nodes: Nodes whose status must be fresh and good.
        fence_m: Corners of the polygon that the rear axle may not leave [m].
        drive_age_s: Oldest command of the policy, since publication [s].
        image_age_s: Oldest camera image, since publication, and oldest capture behind a command [s].
        pose_age_s: Oldest pose of the car, since publication [s].
        status_age_s: Oldest status of a node [s].
        held_up_s: A pause of this process after which it disarms itself [s].
        speed_mps: Greatest magnitude of a commanded speed [m/s].
        steering_rad: Greatest magnitude of a commanded steering angle that is not absurd [rad].
        arm_age_s: A request to arm older than this is void [s].
    """

    nodes: tuple[str, ...]
    fence_m: tuple[tuple[float, float], ...]
    drive_age_s: float = 0.22
    image_age_s: float = 0.25
    pose_age_s: float = 0.2
    status_age_s: float = 1.0
    held_up_s: float = 0.2
    speed_mps: float = 1.0
    steering_rad: float = 0.6
    arm_age_s: float = 1.0


@dataclass
class _Source:
    """Something that must keep coming."""

    publish_ns: int | None = None
    instance_id: int | None = None
    restarted: bool = False

    def heard(self, info: MessageInfo) -> None:
        self.restarted |= self.instance_id is not None and info.instance_id != self.instance_id
        self.publish_ns, self.instance_id = info.publish_mono_ns, info.instance_id

    def age_s(self, mono_ns: int) -> float:
        return math.inf if self.publish_ns is None else (mono_ns - self.publish_ns) / NS_PER_S


@dataclass
class _NodeStatus(_Source):
    state: str = ""
    text: str = ""


@dataclass
class Arming:
    """The state machine. Call `check` at every opportunity; it disarms by itself.

    Attributes:
        limits: Numbers of the checks.
        armed: Whether commands to move may pass.
        reason: Why it is not armed.
        source: Who armed it.
        peer: What the motor controller says it is.
    """

    limits: ArmingLimits
    armed: bool = False
    reason: str = "nobody has armed"
    source: str = ""
    peer: str = ""
    _position_m: tuple[float, float] | None = None
    _disarmed_ns: int = 0
    _last_ns: int | None = None
    _camera: _Source = field(default_factory=_Source)
    _car: _Source = field(default_factory=_Source)
    _drive: _Source = field(default_factory=_Source)
    _capture_ns: int = 0
    _nodes: dict[str, _NodeStatus] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._nodes = {name: _NodeStatus() for name in self.limits.nodes}

    def heard_camera(self, info: MessageInfo) -> None:
        """An image was taken."""
        self._camera.heard(info)

    def heard_car(self, x_m: float, y_m: float, info: MessageInfo) -> None:
        """The car was measured [m]."""
        self._car.heard(info)
        self._position_m = (x_m, y_m)

    def heard_status(self, name: str, state: str, text: str, info: MessageInfo) -> None:
        """A node reported."""
        if name in self._nodes:
            node = self._nodes[name]
            node.heard(info)
            node.state, node.text = state, text

    def heard_drive(
        self, speed_mps: float, steering_rad: float, capture_real_ns: int, info: MessageInfo, mono_ns: int, real_ns: int
    ) -> bool:
        """The policy commands; whether the command may pass on."""
        self._check_held_up(mono_ns)
        fault = self._command_fault(speed_mps, steering_rad, capture_real_ns, real_ns)
        if capture_real_ns > self._capture_ns:
            # A command from an image already used is no sign of life: a frozen camera makes the policy repeat itself.
            self._drive.heard(info)
            self._capture_ns = capture_real_ns
        elif not fault:
            return False
        if fault and self.armed:
            self.disarm(fault, mono_ns)
        return not fault and self.check(mono_ns)

    def check(self, mono_ns: int) -> bool:
        """Disarm if anything is wrong; whether commands to move may pass."""
        self._check_held_up(mono_ns)
        if self.armed and (problem := self.problem(mono_ns)):
            self.disarm(problem, mono_ns)
        return self.armed

    def arm(self, source: str, info: MessageInfo, mono_ns: int) -> None:
        """Somebody wants to arm. A person may; a program only if no real car can move."""
        self._check_held_up(mono_ns)
        if self.armed:
            return
        if (
            info.publish_mono_ns <= self._disarmed_ns
            or mono_ns - info.publish_mono_ns > self.limits.arm_age_s * NS_PER_S
        ):
            self.reason = "not armed: the request to arm is older than what happened since; arm again"
            return
        for watched in self._watched():
            watched.restarted = False  # whatever happened before, this is who is armed with
        if source != OPERATOR and TWIN_PEER not in self.peer.upper():
            self.reason = (
                f"not armed: {source!r} is not a person, and the motor's peer is {self.peer or 'unknown'}, not the twin;"
                f" a real car is armed by source {OPERATOR!r} only"
            )
        elif problem := self.problem(mono_ns):
            self.reason = f"not armed: {problem}"
        else:
            self.armed, self.source, self.reason = True, source, ""

    def disarm(self, reason: str, mono_ns: int) -> None:
        """Stop, and stay stopped until somebody arms again."""
        self.armed, self.reason, self._disarmed_ns = False, reason, mono_ns

    def problem(self, mono_ns: int) -> str:
        """The first thing that is wrong, causes before effects; empty if all is well."""
        limits = self.limits
        for name, node in self._nodes.items():
            if problem := self._node_problem(name, node, mono_ns):
                return problem
        sources = (
            ("no camera image", self._camera, limits.image_age_s),
            ("no pose of the car", self._car, limits.pose_age_s),
            ("no command of the policy", self._drive, limits.drive_age_s),
        )
        for what, source, limit_s in sources:
            if source.restarted:
                return f"{what} from the process that was armed with: it was restarted"
            if (age_s := source.age_s(mono_ns)) > limit_s:
                return f"{what} yet" if math.isinf(age_s) else f"{what} for {age_s:.2f} s"
        assert self._position_m is not None
        if not inside(self._position_m, limits.fence_m):
            return f"the car is outside the fence, at ({self._position_m[0]:.2f}, {self._position_m[1]:.2f}) m"
        return ""

    def drive_age_s(self, mono_ns: int) -> float:
        """Age of the newest command [s]."""
        return self._drive.age_s(mono_ns)

    def pose_age_s(self, mono_ns: int) -> float:
        """Age of the newest pose of the car [s]."""
        return self._car.age_s(mono_ns)

    def _watched(self) -> list[_Source]:
        return [self._camera, self._car, self._drive, *self._nodes.values()]

    def _node_problem(self, name: str, node: _NodeStatus, mono_ns: int) -> str:
        if node.restarted:
            return f"node {name} was restarted"
        if (age_s := node.age_s(mono_ns)) > self.limits.status_age_s:
            return (
                f"node {name} has not reported yet" if math.isinf(age_s) else f"node {name} is silent for {age_s:.1f} s"
            )
        if node.state not in _ALIVE_STATES:
            return f"node {name} is in state {node.state}: {node.text}"
        return ""

    def _command_fault(self, speed_mps: float, steering_rad: float, capture_real_ns: int, real_ns: int) -> str:
        if not (math.isfinite(speed_mps) and math.isfinite(steering_rad)):
            return f"a command that is not finite: {speed_mps} m/s, {steering_rad} rad"
        if abs(speed_mps) > self.limits.speed_mps:
            return f"a command of {speed_mps:.2f} m/s, the limit is {self.limits.speed_mps:.2f} m/s"
        if abs(steering_rad) > self.limits.steering_rad:
            return f"a command of {steering_rad:.2f} rad, the limit is {self.limits.steering_rad:.2f} rad"
        age_s = (real_ns - capture_real_ns) / NS_PER_S
        if not -0.05 <= age_s <= self.limits.image_age_s:
            return f"a command from an image {age_s:.2f} s old"
        return ""

    def _check_held_up(self, mono_ns: int) -> None:
        pause_s = 0.0 if self._last_ns is None else (mono_ns - self._last_ns) / NS_PER_S
        self._last_ns = mono_ns
        if self.armed and pause_s > self.limits.held_up_s:
            # Stopped by a signal, or the computer was: what was checked before says nothing about now.
            self.disarm(f"the safety node was held up for {pause_s:.2f} s", mono_ns)


def inside(point_m: tuple[float, float], polygon_m: Sequence[tuple[float, float]]) -> bool:
    """Whether a point lies inside a simple polygon (even-odd rule); false for points that are not finite."""
    x, y = point_m
    if not (math.isfinite(x) and math.isfinite(y)):
        return False
    result = False
    for (ax, ay), (bx, by) in zip(polygon_m, [*polygon_m[1:], polygon_m[0]], strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            result = not result
    return result
