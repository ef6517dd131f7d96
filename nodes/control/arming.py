"""The arming state machine. Any failed check disarms the car until a new request arms it.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from calibration.fence import edge_distance_m, inside
from nodes.control.arming_gates import ClockGate, HandGate
from nodes.control.stamps import captured_mono_ns, stamp_age_s, stamp_problem
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.requests import ESTOP_LATCHED
from nodes.runtime.twin_port import is_twin
from nodes.runtime.wire import MessageInfo

OPERATOR = "operator"
MAX_SPEED_MPS = 1.0  # fastest command without another limit
_ALIVE_STATES = ("ready", "active")


@dataclass(frozen=True)
class ArmingLimits:
    """Limits of the checks.

    Attributes:
        nodes: Nodes whose status must be fresh and without a fault.
        fence_m: Corners of the polygon that the rear axle must not leave [m].
        drivers: Nodes that may command the car, highest priority first.
        fence_margin_m: Smallest distance of the rear axle from the fence [m].
        drive_age_s: Largest age of the active driver's newest command since publication [s].
        image_age_s: Largest age of the newest camera image since publication, and of the image that a command is based on [s].
        pose_age_s: Largest age of the car's newest pose since publication [s].
        motor_age_s: Largest age of the motor node's newest telemetry since publication [s].
        status_age_s: Largest age of a node's newest status [s].
        held_up_s: Longest pause of this process; a longer one disarms the car [s].
        speed_mps: Largest magnitude of a commanded speed [m/s].
        steering_rad: Largest magnitude of a commanded steering angle [rad].
        arm_age_s: Largest age of a request to arm [s].
    """

    nodes: tuple[str, ...]
    fence_m: tuple[tuple[float, float], ...]
    drivers: tuple[str, ...] = ("policy",)
    fence_margin_m: float = 0.0
    drive_age_s: float = 0.22
    image_age_s: float = 0.25
    pose_age_s: float = 0.2
    motor_age_s: float = 0.2
    status_age_s: float = 1.0
    held_up_s: float = 0.2
    speed_mps: float = 1.0
    steering_rad: float = 0.6
    arm_age_s: float = 1.0


class Gate(Protocol):
    """An independent check."""

    def problem(self, mono_ns: int) -> str:
        """Return why the car may not move; empty if it may."""
        ...


@dataclass
class _Source:
    """A message stream that must not stop."""

    publish_ns: int | None = None
    instance_id: int | None = None
    restarted: bool = False

    def heard(self, info: MessageInfo) -> None:
        self.restarted |= self.instance_id is not None and info.instance_id != self.instance_id
        self.publish_ns, self.instance_id = info.fresh_mono_ns, info.instance_id

    def age_s(self, mono_ns: int) -> float:
        return math.inf if self.publish_ns is None else (mono_ns - self.publish_ns) / NS_PER_S


@dataclass
class _Driver(_Source):
    capture_ns: int = 0
    refused: str = ""


@dataclass
class _NodeStatus(_Source):
    state: str = ""
    text: str = ""
    recorded: bool = False


@dataclass
class Arming:
    """The arming state machine. Call `check` at every message and tick; it disarms the car if a check fails.

    Attributes:
        limits: Limits of the checks.
        armed: Whether commands to move may pass.
        reason: Why the car is not armed.
        source: Source of the request that armed the car.
        peer: Identity that the motor controller reports.
        hand: The check of the held button.
        clocks: The check of other hosts' clocks.
        gates: Further checks, run in this order after all others except the fence.
        driver: The active driver, whose commands pass. If it stops sending, the next driver does not replace it.
    """

    limits: ArmingLimits
    hand: HandGate = field(default_factory=HandGate)
    clocks: ClockGate = field(default_factory=ClockGate)
    gates: Sequence[Gate] = ()
    armed: bool = False
    reason: str = "not armed since the start"
    source: str = ""
    peer: str = ""
    driver: str = ""
    _estop: str = ""
    _position_m: tuple[float, float] | None = None
    _disarmed_ns: int = 0
    _fault: str = ""
    _fault_ns: int = 0
    _last_ns: int | None = None
    _camera: _Source = field(default_factory=_Source)
    _car: _Source = field(default_factory=_Source)
    _motor: _Source = field(default_factory=_Source)
    _drivers: dict[str, _Driver] = field(default_factory=dict)
    _nodes: dict[str, _NodeStatus] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._nodes = {name: _NodeStatus() for name in self.limits.nodes}
        self._drivers = {name: _Driver() for name in self.limits.drivers}
        self.driver = self.limits.drivers[0]

    def heard_camera(self, info: MessageInfo) -> None:
        """Note a camera image."""
        self._camera.heard(info)

    def heard_car(self, x_m: float, y_m: float, info: MessageInfo) -> None:
        """Note a measured position of the car [m]."""
        self._car.heard(info)
        self._position_m = (x_m, y_m)

    def heard_motor(self, info: MessageInfo) -> None:
        """Note telemetry of the motor node."""
        self._motor.heard(info)

    def heard_status(
        self, name: str, state: str, text: str, info: MessageInfo, recorded: bool = False
    ) -> None:
        """Note the status of a node, and whether it plays a recording."""
        if name in self._nodes:
            node = self._nodes[name]
            node.heard(info)
            node.state, node.text, node.recorded = state, text, recorded

    def heard_drive(
        self,
        speed_mps: float,
        steering_rad: float,
        capture_real_ns: int,
        info: MessageInfo,
        mono_ns: int,
        real_ns: int,
        driver: str = "policy",
    ) -> bool:
        """Note a command of a driver. Returns whether the command may pass."""
        self._check_held_up(mono_ns)
        source, now = self._drivers[driver], Now(mono_ns, real_ns)
        source.refused = (
            self._command_fault(speed_mps, steering_rad)
            or self._capture_fault(capture_real_ns, now)
            or self._order_fault(source, driver, capture_real_ns)
        )
        if source.refused:
            if self.armed and driver == self.driver and not self.hand.drives:
                self.disarm(source.refused, mono_ns)
            return False
        if capture_real_ns == source.capture_ns:
            # A command based on an image that was already used does not count as fresh: with a frozen camera, the policy
            # repeats its command.
            return False
        # Only a command that is accepted moves the comparison: a stamp of a wrong clock must not lock out the right ones.
        source.heard(info)
        source.capture_ns = capture_real_ns
        order = self.limits.drivers
        if not self.armed or order.index(driver) < order.index(self.driver):
            self._give_way(driver, mono_ns)
        return driver == self.driver and not self.hand.drives and self.check(mono_ns)

    def heard_hand(
        self,
        mode: str,
        pressed_stop: bool,
        speed_mps: float,
        steering_rad: float,
        info: MessageInfo,
        stamp_ns: int,
        now: Now,
    ) -> bool:
        """Note a message of the teleop node. Returns whether its own command may pass.

        Pressing the button arms the car. After it is released, or after any other disarming, it must be pressed again. Only an
        explicit request of the operator clears an e-stop. A message whose stamp is not of a moment ago can only stop the car.
        """
        mono_ns = now.mono_ns
        self._check_held_up(mono_ns)
        since_ns = min(captured_mono_ns(stamp_ns, now), info.fresh_mono_ns)
        age_s = stamp_age_s(stamp_ns, now.real_ns)
        began = False
        if refused := stamp_problem(age_s, self.hand.age_limit_s, self.clocks.ahead_s(mono_ns)):
            self.hand.refuse(f"the teleop node's message does not count: {refused}")
        else:
            began = self.hand.heard(mode, pressed_stop, info, since_ns)
        if pressed_stop:
            self._estop = ESTOP_LATCHED
            self.disarm(self._estop, mono_ns)
        elif began and self.hand.required:
            self.arm(OPERATOR, since_ns, mono_ns, explicit=False)
        if refused:
            self.check(mono_ns)
            return False
        if self.hand.drives and self.armed and (fault := self._command_fault(speed_mps, steering_rad)):
            self.disarm(fault, mono_ns)
        return self.check(mono_ns) and self.hand.drives

    def check(self, mono_ns: int) -> bool:
        """Disarm if a check fails. Returns whether commands to move may pass."""
        self._check_held_up(mono_ns)
        if self.armed:
            if problem := self.problem(mono_ns):
                self.disarm(problem, mono_ns)
        elif fault := self._passing_fault(mono_ns):
            self._fault, self._fault_ns = fault, mono_ns
        return self.armed

    def arm(self, source: str, asked_ns: int, mono_ns: int, explicit: bool = True) -> str:
        """Decide a request to arm. The operator may arm any car, a program only the simulated one.

        Args:
            source: Source of the request.
            asked_ns: Time of the first repeat of the request [ns].
            mono_ns: Current time [ns].
            explicit: Whether the request is explicit and so clears an e-stop. A held button is not.

        Returns:
            Why the car is not armed; empty if it is.
        """
        self._check_held_up(mono_ns)
        if self.armed:
            return ""
        asked_ns -= self.clocks.doubt_ns(mono_ns)
        if void := self._void(asked_ns, mono_ns):
            # A wrong clock makes every request look old, and asking again does not help.
            return self.clocks.problem(mono_ns) or void
        for watched in self._watched():
            watched.restarted = False  # the running process is accepted
        if explicit and source == OPERATOR and not self.hand.pressed_stop:
            self._estop = ""
        self.driver = self._first_fresh(mono_ns)
        if source != OPERATOR and not is_twin(self.peer):
            refusal = (
                f"expected source {OPERATOR!r} for a real car, got {source!r}; the motor's peer is {self.peer or 'unknown'},"
                " not the twin. Arm with advnerf car arm"
            )
        elif not (refusal := self.problem(mono_ns)) and explicit and asked_ns <= self._fault_ns:
            refusal = f"a fault occurred after the request: {self._fault}; arm again"
        if refusal:
            self.reason = f"not armed: {refusal}"
        else:
            self.armed, self.source, self.reason = True, source, ""
        return refusal

    def disarm(self, reason: str, mono_ns: int) -> None:
        """Stop the car until the next request to arm is granted."""
        self.armed, self.reason, self._disarmed_ns = False, reason, mono_ns

    def problem(self, mono_ns: int) -> str:
        """Return the first failed check, causes before effects; empty if all pass."""
        return (
            self._estop
            or self.hand.problem(mono_ns)
            or self._restart_problem()
            or self._passing_fault(mono_ns)
        )

    def _restart_problem(self) -> str:
        """Name a source that was restarted since the arming. The next arming accepts the new process."""
        for name, node in self._nodes.items():
            if node.restarted:
                return f"node {name} was restarted"
        for what, source, _ in self._sources():
            if source.restarted:
                return f"{what} from the process that ran at arming: it was restarted"
        return ""

    def _passing_fault(self, mono_ns: int) -> str:
        """Return the first fault that ends without a new arming, such as missing messages."""
        if problem := self.clocks.problem(mono_ns):
            return problem
        for name, node in self._nodes.items():
            if problem := self._node_problem(name, node, mono_ns):
                return problem
        for what, source, limit_s in self._sources():
            if (age_s := source.age_s(mono_ns)) > limit_s:
                why = f" ({source.refused})" if isinstance(source, _Driver) and source.refused else ""
                return f"{what} yet{why}" if math.isinf(age_s) else f"{what} for {age_s:.2f} s{why}"
        return next(filter(None, (gate.problem(mono_ns) for gate in self.gates)), "") or self._fence_problem()

    def _sources(self) -> list[tuple[str, _Source, float]]:
        limits = self.limits
        sources: list[tuple[str, _Source, float]] = [("no pose of the car", self._car, limits.pose_age_s)]
        if "camera" in limits.nodes:
            sources.insert(0, ("no camera image", self._camera, limits.image_age_s))
        if "motor" in limits.nodes:
            sources.append(("no telemetry from the motor node", self._motor, limits.motor_age_s))
        if not self.hand.drives:
            sources.append(
                (f"no command from the {self.driver}", self._drivers[self.driver], limits.drive_age_s)
            )
        return sources

    @property
    def stopped_by(self) -> str:
        """Why the car is not armed. A latched e-stop comes before everything that happened since."""
        return self._estop or self.reason

    def drive_age_s(self, mono_ns: int) -> float:
        """Age of the newest command [s]."""
        return self._drivers[self.driver].age_s(mono_ns)

    def pose_age_s(self, mono_ns: int) -> float:
        """Age of the newest pose of the car [s]."""
        return self._car.age_s(mono_ns)

    def _void(self, asked_ns: int, mono_ns: int) -> str:
        """Return why a request to arm is void; empty if it is valid."""
        if asked_ns <= self._disarmed_ns:
            return f"the request is older than the last stop ({self.reason}); arm again"
        age_s, limit_s = (mono_ns - asked_ns) / NS_PER_S, self.limits.arm_age_s
        if age_s > limit_s:
            return f"the request is {age_s:.1f} s old, the limit is {limit_s:g} s; arm again"
        return ""

    def _watched(self) -> list[_Source]:
        return [self._camera, self._car, self._motor, *self._drivers.values(), *self._nodes.values()]

    def _first_fresh(self, mono_ns: int) -> str:
        fresh = [name for name, d in self._drivers.items() if d.age_s(mono_ns) <= self.limits.drive_age_s]
        return fresh[0] if fresh else self.limits.drivers[0]

    def _give_way(self, driver: str, mono_ns: int) -> None:
        """Let a driver of higher priority take over at once. While disarmed, the first driver with a fresh command is chosen."""
        self.driver = driver if self.armed else self._first_fresh(mono_ns)
        self._drivers[self.driver].restarted &= self.armed

    def _fence_problem(self) -> str:
        assert self._position_m is not None
        x_m, y_m = self._position_m
        if not inside(self._position_m, self.limits.fence_m):
            return f"the car is outside the fence, at ({x_m:.2f}, {y_m:.2f}) m"
        margin_m = self.limits.fence_margin_m
        if margin_m and (distance_m := edge_distance_m(self._position_m, self.limits.fence_m)) < margin_m:
            return f"the car is {distance_m:.2f} m from the fence, at ({x_m:.2f}, {y_m:.2f}) m; the margin is {margin_m:.2f} m"
        return ""

    def _node_problem(self, name: str, node: _NodeStatus, mono_ns: int) -> str:
        if (age_s := node.age_s(mono_ns)) > self.limits.status_age_s:
            return (
                f"node {name} has not reported yet"
                if math.isinf(age_s)
                else f"node {name} has been silent for {age_s:.1f} s"
            )
        if node.state not in _ALIVE_STATES:
            return f"node {name} is in state {node.state}: {node.text}"
        if node.recorded and not is_twin(self.peer):
            return (
                f"node {name} plays a recording, by which the simulated car alone may drive; the motor's peer is {self.peer or 'unknown'}, "
                "not the twin"
            )
        return ""

    def _command_fault(self, speed_mps: float, steering_rad: float) -> str:
        if not (math.isfinite(speed_mps) and math.isfinite(steering_rad)):
            return f"a command that is not finite: {speed_mps} m/s, {steering_rad} rad"
        if abs(speed_mps) > self.limits.speed_mps:
            return f"a command of {speed_mps:.2f} m/s, the limit is {self.limits.speed_mps:.2f} m/s"
        if abs(steering_rad) > self.limits.steering_rad:
            return f"a command of {steering_rad:.2f} rad, the limit is {self.limits.steering_rad:.2f} rad"
        return ""

    def _capture_fault(self, capture_real_ns: int, now: Now) -> str:
        age_s = stamp_age_s(capture_real_ns, now.real_ns)
        problem = stamp_problem(age_s, self.limits.image_age_s, self.clocks.ahead_s(now.mono_ns))
        return f"a command that does not count: {problem}" if problem else ""

    def _order_fault(self, source: _Driver, driver: str, capture_real_ns: int) -> str:
        """Name a stamp that goes back, which shows a wrong clock. While disarmed, the comparison starts again with it."""
        back_s = (source.capture_ns - capture_real_ns) / NS_PER_S
        return (
            f"the stamps of the {driver}'s commands went back by {back_s:.2f} s"
            if self.armed and back_s > 0.0
            else ""
        )

    def _check_held_up(self, mono_ns: int) -> None:
        if self._last_ns is None:
            # First check: requests made before this process started are void.
            self._last_ns = self._disarmed_ns = mono_ns
        pause_s = (mono_ns - self._last_ns) / NS_PER_S
        self._last_ns = mono_ns
        if self.armed and pause_s > self.limits.held_up_s:
            # This process or the computer was suspended, so the earlier checks are no longer valid.
            self.disarm(f"the safety node was held up for {pause_s:.2f} s", mono_ns)
