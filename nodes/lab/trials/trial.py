"""One measured drive: place the car at its start, arm, drive for the horizon, disarm, wait until the car stands.

The operator of a trial is a node, so that it also runs in tests and replays without sockets. It moves and arms the car only if the
motor's peer reports that it is the twin. With a real car, the node guides the human operator to the start pose, asks for the arming,
and waits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from advnerf_core.driving.metrics import MOVED_M
from advnerf_core.geometry import planar_pose, wrap_angle, yaw_of
from nodes.runtime.arm_requests import BRAKE_WAIT_S, arm_message
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.errors import NodeFinished, RuntimeFault
from nodes.runtime.messages import finite_pose, ns_from_stamp, pose_message
from nodes.runtime.node import MessageInfo, Node, Out
from nodes.runtime.requests import RequestIdentity
from nodes.runtime.topics import status_topic
from nodes.runtime.twin_port import is_twin

_REPEAT_S = 0.5
_SETTLE_S = 0.5
_AT_START_M, _AT_START_RAD = 0.03, 0.05
_SPOT_M = 0.005
_STANDING_S = 0.5
_GUIDE_S = 0.25


class TrialError(RuntimeFault):
    """A trial could not be carried out."""


class SpoiledError(TrialError):
    """The drive measures nothing, because load or a fault of the stack ended, delayed or prevented it. It may be driven again."""


class Phase(Enum):
    """Phase of a trial."""

    GATHERING = "waiting for the nodes"
    PLACING = "putting the car on its start"
    ARMING = "arming"
    DRIVING = "driving"
    STOPPING = "stopping"
    DONE = "done"


@dataclass(frozen=True)
class TrialPlan:
    """Plan of one drive.

    Attributes:
        start_pose: Pose of the rear axle: x [m], y [m], yaw [rad].
        duration_s: Time from the first motion to the disarming [s].
        nodes: Nodes that must be ready before anything moves.
        patience_s: Longest time for each phase except driving, unless it depends on the operator [s].
        by_hand: Whether a real car may be driven, which the operator places and arms.
    """

    start_pose: tuple[float, float, float]
    duration_s: float
    nodes: tuple[str, ...]
    patience_s: float = 20.0
    by_hand: bool = False


@dataclass
class TrialOutcome:
    """Outcome of a trial.

    Attributes:
        start_real_ns: Capture time of the first moved pose, CLOCK_REALTIME [ns]; 0 if the car did not move.
        end_real_ns: Time at which the trial disarmed or the stack stopped [ns].
        stopped_early: Why the stack stopped before the end of the horizon; empty if it did not.
        peer: Identity that the motor controller reports.
    """

    start_real_ns: int = 0
    end_real_ns: int = 0
    stopped_early: str = ""
    peer: str = ""


@dataclass
class _NewestMessages:
    """The newest observed messages."""

    ready: set[str] = field(default_factory=set)
    T_world_from_car: Any = None
    spot_m: Any = None
    standing_since_ns: int | None = None
    armed: bool = False
    answered_id: str = ""
    granted: bool = False
    safety_reason: str = ""
    peer: str = ""


class TrialNode(Node):
    """The operator of one trial.

    Args:
        trouble: Called at every tick. It returns why the graph has failed, which ends the trial, or an empty text.
        guide: Called several times a second with instructions for the human operator.
    """

    tick_rate_hz = 20.0
    publications = ("/arm", "/twin/reset")

    def __init__(
        self, plan: TrialPlan, trouble: Callable[[], str] = str, guide: Callable[[str], None] | None = None
    ) -> None:
        self.plan = plan
        self._trouble = trouble
        self._guide = guide or (lambda text: None)
        self._by_hand = False
        self.outcome = TrialOutcome()
        self.phase = Phase.GATHERING
        self.subscriptions = ("/vicon/car", "/safety/state", "/motor/sent", *map(status_topic, plan.nodes))
        self._seen = _NewestMessages()
        self._phase_began_ns: int | None = None
        self._said_ns = 0
        self._asked: RequestIdentity | None = None

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Note a message. A pose of the car is handled at once."""
        if topic == "/vicon/car":
            self._see_car(message, now)
        elif topic == "/safety/state":
            self._see_safety(message)
        elif topic == "/motor/sent":
            self._seen.peer = str(message.peer)
        else:
            self._see_status(message)
        return []

    def tick(self, now: Now) -> list[Out]:
        """Enter the next phase if this one is finished, and repeat unanswered requests."""
        if self._phase_began_ns is None:
            self._phase_began_ns = now.mono_ns
        step = {
            Phase.GATHERING: self._gather,
            Phase.PLACING: self._place,
            Phase.ARMING: self._arm,
            Phase.DRIVING: self._drive,
            Phase.STOPPING: self._stop,
        }
        if self.phase is Phase.DONE:
            raise NodeFinished
        if trouble := self._trouble():
            raise TrialError(f"the graph failed while {self.phase.value}: {trouble}")
        waited_s = (now.mono_ns - self._phase_began_ns) / NS_PER_S
        a_persons_turn = self._by_hand and self.phase in (Phase.PLACING, Phase.ARMING)
        if self.phase is not Phase.DRIVING and not a_persons_turn and waited_s > self.plan.patience_s:
            error = TrialError if self.phase is Phase.STOPPING else SpoiledError
            raise error(f"gave up after {waited_s:.0f} s of {self.phase.value}: {self._what_is_missing()}")
        return step[self.phase](now)

    def status(self) -> tuple[str, str]:
        """Report the phase."""
        return "active", self.phase.value

    def _see_car(self, message: Any, now: Now) -> None:
        if (T := finite_pose(message)) is None:
            return  # as if none had come
        stamp_ns = ns_from_stamp(message.header.stamp)
        seen = self._seen
        # Speed from consecutive poses would be noise. The car stands if it has not left a spot for some time.
        if seen.spot_m is None or float(np.linalg.norm(T[:3, 3] - seen.spot_m)) > _SPOT_M:
            seen.spot_m, seen.standing_since_ns = T[:3, 3].copy(), now.mono_ns
        seen.T_world_from_car = T
        if self.phase in (Phase.ARMING, Phase.DRIVING) and not self.outcome.start_real_ns:
            offset_m = float(np.linalg.norm(T[:2, 3] - self._start_xy))
            if offset_m > MOVED_M:
                self.outcome.start_real_ns = stamp_ns

    def _see_safety(self, message: Any) -> None:
        seen = self._seen
        seen.armed, seen.safety_reason = bool(message.armed), str(message.reason)
        seen.answered_id, seen.granted = str(message.answered_id), bool(message.granted)

    def _see_status(self, message: Any) -> None:
        if message.state in ("ready", "active"):
            self._seen.ready.add(str(message.node))
        else:
            self._seen.ready.discard(str(message.node))

    def _gather(self, now: Now) -> list[Out]:
        seen = self._seen
        if set(self.plan.nodes) <= seen.ready and seen.T_world_from_car is not None and seen.peer:
            self._by_hand = not is_twin(seen.peer)
            if self._by_hand and not self.plan.by_hand:
                raise TrialError(
                    f"expected the motor's peer to be the twin, got {seen.peer!r}; only the operator may arm a real car"
                )
            self.outcome.peer = seen.peer
            self._enter(Phase.PLACING, now)
        return []

    def _place(self, now: Now) -> list[Out]:
        if self._at_start() and self._stood_s(now) > _SETTLE_S:
            self._start_xy = self._seen.T_world_from_car[:2, 3].copy()
            self._enter(Phase.ARMING, now)
            return []
        if self._by_hand:
            return self._tell(self._way_to_start(now), now)
        return self._say(
            Out("/twin/reset", pose_message(planar_pose(*self.plan.start_pose), now.real_ns)), now
        )

    def _arm(self, now: Now) -> list[Out]:
        if self._seen.armed:
            self._enter(Phase.DRIVING, now)
            return []
        if self._by_hand:
            if not self._at_start():
                self._enter(Phase.PLACING, now)
                return []
            why = self._seen.safety_reason or "not armed since the start"
            return self._tell(
                f"on the start. ARM to drive (gamepad, or: advnerf car arm). Not armed: {why}", now
            )
        if self._asked is not None and self._seen.answered_id == self._asked.ask_id:
            if self._seen.granted:  # armed, and stopped before the trial noticed; do not arm a second time
                self._enter(Phase.DRIVING, now)
                return []
            if now.mono_ns - self._asked.mono_ns < _REPEAT_S * NS_PER_S:
                return []
            self._asked = None  # refused; ask again, because the missing condition may now be met
        return [self._arm_message(True, now)]

    def _drive(self, now: Now) -> list[Out]:
        began_ns = self.outcome.start_real_ns
        if not self._seen.armed:
            self.outcome.stopped_early = self._seen.safety_reason or "disarmed"
        driven = began_ns and now.real_ns - began_ns > self.plan.duration_s * NS_PER_S
        if self.outcome.stopped_early or driven:
            self.outcome.end_real_ns = now.real_ns
            self._enter(Phase.STOPPING, now)
            return [self._arm_message(False, now)]
        if not began_ns and self._phase_s(now) > self.plan.patience_s:
            raise TrialError(
                f"armed, but the car did not move within {self.plan.patience_s:g} s; is the policy running?"
            )
        return []

    def _stop(self, now: Now) -> list[Out]:
        if not self._seen.armed and self._stood_s(now) > _STANDING_S:
            self._enter(Phase.DONE, now)
            return []
        answered = self._asked is not None and self._seen.answered_id == self._asked.ask_id
        if not answered and self._phase_s(now) > BRAKE_WAIT_S:
            self._tell("NOT CONFIRMED: no answer from the safety node. Use the hardware stop", now)
        return [] if answered and not self._seen.armed else [self._arm_message(False, now)]

    def _enter(self, phase: Phase, now: Now) -> None:
        self.phase, self._phase_began_ns, self._said_ns, self._asked = phase, now.mono_ns, 0, None

    def _phase_s(self, now: Now) -> float:
        return (now.mono_ns - (self._phase_began_ns or now.mono_ns)) / NS_PER_S

    def _stood_s(self, now: Now) -> float:
        since = self._seen.standing_since_ns
        return 0.0 if since is None else (now.mono_ns - since) / NS_PER_S

    def _at_start(self) -> bool:
        T, (x_m, y_m, yaw_rad) = self._seen.T_world_from_car, self.plan.start_pose
        near = np.hypot(T[0, 3] - x_m, T[1, 3] - y_m) < _AT_START_M
        return bool(near and abs(float(wrap_angle(yaw_of(T) - yaw_rad))) < _AT_START_RAD)

    def _say(self, out: Out, now: Now) -> list[Out]:
        """Repeat a request until it has an effect, because its receiver may not be connected at first."""
        if self._said_ns and now.mono_ns - self._said_ns < _REPEAT_S * NS_PER_S:
            return []
        self._said_ns = now.mono_ns
        return [out]

    def _tell(self, text: str, now: Now) -> list[Out]:
        if now.mono_ns - self._said_ns >= _GUIDE_S * NS_PER_S:
            self._said_ns = now.mono_ns
            self._guide(text)
        return []

    def _way_to_start(self, now: Now) -> str:
        """Describe the way from the car to the start pose, for the human operator."""
        T, (x_m, y_m, yaw_rad) = self._seen.T_world_from_car, self.plan.start_pose
        forward_m, left_m = T[:2, :2].T @ (np.array([x_m, y_m]) - T[:2, 3])
        turn_deg = np.rad2deg(float(wrap_angle(yaw_rad - yaw_of(T))))
        if self._at_start():
            return f"on the start, hold still ({self._stood_s(now):.1f} s)"
        return (
            f"to the start: {abs(100 * forward_m):.1f} cm {'forward' if forward_m >= 0 else 'back'}, "
            f"{abs(100 * left_m):.1f} cm {'left' if left_m >= 0 else 'right'}, turn {abs(turn_deg):.1f} deg "
            f"{'left' if turn_deg >= 0 else 'right'}"
        )

    def _arm_message(self, arm: bool, now: Now) -> Out:
        """Make a repeat of the request of this phase."""
        self._asked = self._asked or RequestIdentity.at(now)
        reason = "trial starts" if arm else "trial is over"
        return Out("/arm", arm_message(self._asked, now, arm, "trial", reason))

    def _what_is_missing(self) -> str:
        seen = self._seen
        missing = sorted(set(self.plan.nodes) - seen.ready)
        if missing:
            return f"not ready: {', '.join(missing)}"
        if seen.T_world_from_car is None:
            return "no pose of the car on /vicon/car"
        if not seen.peer:
            return "the motor node has not reported its controller"
        return f"reason of the safety node: {seen.safety_reason or 'none'}"
