import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from nodes.lab.trials.trial import Phase, TrialError, TrialNode, TrialPlan
from nodes.runtime.clock import Now
from nodes.runtime.errors import NodeFinished
from nodes.runtime.messages import header, pose_message, types
from tests.support.messages import filled

pytestmark = pytest.mark.live

REAL_NS = 1_700_000_000_000_000_000
START = (-1.1, -2.0, 0.0)


class Stage:
    """A trial node, its clock, and a car that does what the operator asks for."""

    def __init__(self, peer="TWIN firmware 5.02", moves=True, **plan):
        self.node = TrialNode(TrialPlan(START, 1.0, ("camera", "motor"), **plan))
        self.t_s, self.pose, self.armed, self.reason, self.sent = (
            0.0,
            np.array([0.0, 0.0, 1.0]),
            False,
            "",
            [],
        )
        self.peer, self.moves, self.requests = peer, moves, []
        self.answered_id, self.granted, self.grants, self.hears = "", False, True, True

    @property
    def now(self):
        return Now(int(self.t_s * 1e9), REAL_NS + int(self.t_s * 1e9))

    def hear(self, topic, message):
        self.node.handle(topic, message, None, self.now)

    def step(self):
        self.t_s += 0.05
        if self.armed and self.moves:
            self.pose = np.add(self.pose, [0.04, 0.0, 0.0])
        jitter = 1e-4 * np.sin(self.t_s * 1e3)
        T = planar_pose(self.pose[0] + jitter, self.pose[1], self.pose[2])
        self.hear("/vicon/car", pose_message(T, self.now.real_ns))
        state = filled(
            types.SafetyState,
            header=header(self.now.real_ns),
            armed=self.armed,
            stopping=not self.armed,
            reason=self.reason,
            answered_id=self.answered_id,
            granted=self.granted,
        )
        self.hear("/safety/state", state)
        for topic, message in self.node.tick(self.now):
            self.sent.append(topic)
            if topic == "/twin/reset":
                self.pose = np.array(START)
            elif self.hears:
                self.requests.append((message.ask_id, bool(message.arm)))
                self.answered_id, self.granted = message.ask_id, not message.arm or self.grants
                self.armed = bool(message.arm) and self.grants

    def nodes_are_ready(self):
        for name in ("camera", "motor"):
            self.hear(f"/status/{name}", status(name, "active"))
        sent = filled(types.MotorSent, servo=0.5, braking=True, peer=self.peer)
        self.hear("/motor/sent", sent)

    def run_until(self, phase, limit_s=30.0):
        while self.node.phase is not phase:
            assert self.t_s < limit_s, f"stuck while {self.node.phase}"
            self.step()


def status(node, state):
    none = np.zeros(0)
    return filled(
        types.NodeStatus,
        node=node,
        pid=1,
        state=state,
        subscribers=none.astype(np.uint32),
        counter_values=none,
    )


def test_a_trial_places_arms_drives_for_its_time_and_disarms():
    stage = Stage()
    stage.nodes_are_ready()
    stage.run_until(Phase.DONE)
    outcome = stage.node.outcome
    assert outcome.peer == "TWIN firmware 5.02"
    assert outcome.stopped_early == ""
    assert (outcome.end_real_ns - outcome.start_real_ns) / 1e9 == pytest.approx(1.0, abs=0.11)
    assert not stage.armed
    assert stage.sent.index("/twin/reset") < stage.sent.index("/arm")
    with pytest.raises(NodeFinished):
        stage.step()


def test_nothing_is_placed_or_armed_before_every_node_is_ready():
    stage = Stage()
    stage.hear("/status/camera", status("camera", "active"))
    for _ in range(100):
        stage.step()
    assert stage.sent == []
    assert stage.node.phase is Phase.GATHERING


def test_a_real_car_is_never_armed():
    stage = Stage(peer="60_MK5 5.2")
    stage.nodes_are_ready()
    with pytest.raises(TrialError, match=r"only the operator may arm a real car"):
        stage.run_until(Phase.ARMING)
    assert "/arm" not in stage.sent


def test_a_fence_stop_ends_the_drive_with_its_reason():
    stage = Stage()
    stage.nodes_are_ready()
    stage.run_until(Phase.DRIVING)
    for _ in range(4):
        stage.step()
    stage.armed, stage.reason = False, "outside the fence"
    stage.run_until(Phase.DONE)
    assert stage.node.outcome.stopped_early == "outside the fence"


def test_a_car_that_does_not_move_and_a_missing_node_are_named():
    stage = Stage(moves=False, patience_s=3.0)
    stage.nodes_are_ready()
    with pytest.raises(TrialError, match="did not move"):
        stage.run_until(Phase.DONE)
    stage = Stage(patience_s=2.0)
    stage.hear("/status/camera", status("camera", "active"))
    with pytest.raises(TrialError, match="not ready: motor"):
        stage.run_until(Phase.DONE)


def test_a_failed_graph_ends_the_trial():
    stage = Stage()
    stage.node = TrialNode(stage.node.plan, lambda: "required node camera died")
    with pytest.raises(TrialError, match="camera died"):
        stage.step()


def test_a_request_is_repeated_under_one_id_until_it_is_answered():
    stage = Stage()
    stage.nodes_are_ready()
    stage.run_until(Phase.ARMING)
    stage.hears = False
    for _ in range(10):
        stage.step()
    assert stage.sent.count("/arm") >= 9
    stage.hears = True
    stage.run_until(Phase.DONE)
    assert [arm for _, arm in stage.requests] == [True, False]
    assert len({ask_id for ask_id, _ in stage.requests}) == 2


def test_a_refused_arming_is_asked_again_as_another_request():
    stage = Stage()
    stage.nodes_are_ready()
    stage.grants = False
    stage.run_until(Phase.ARMING)
    for _ in range(41):
        stage.step()
    assert len(stage.requests) == len({ask_id for ask_id, _ in stage.requests}) == 4
    stage.grants = True
    stage.run_until(Phase.DONE)


def test_a_car_that_was_stopped_before_the_trial_heard_of_its_arming_is_not_armed_again():
    stage = Stage()
    stage.nodes_are_ready()
    stage.run_until(Phase.ARMING)
    while not stage.requests:
        stage.step()
    stage.armed, stage.reason = False, "no pose of the car for 0.30 s"
    stage.run_until(Phase.DONE)
    assert stage.node.outcome.stopped_early == "no pose of the car for 0.30 s"
    assert [arm for _, arm in stage.requests] == [True, False]


class HandStage(Stage):
    """A real car: it is where a person pushes it, and only a person arms it."""

    def __init__(self):
        super().__init__(peer="60_MK5 5.2")
        self.told = []
        self.node = TrialNode(
            TrialPlan(START, 1.0, ("camera", "motor"), patience_s=3.0, by_hand=True), str, self.told.append
        )


def test_a_person_is_guided_to_the_start_and_arms_the_real_car():
    stage = HandStage()
    stage.pose = np.array([-1.3, -2.05, 0.2])
    stage.nodes_are_ready()
    stage.run_until(Phase.PLACING)
    for _ in range(200):  # a person may take longer than any patience
        stage.step()
    # Seen from a car turned by 0.2 rad, (0.2, 0.05) m is 20.6 cm forward and 0.9 cm left.
    assert "20.6 cm forward, 0.9 cm left, turn 11.5 deg right" in stage.told[-1]
    stage.pose = np.array(START)
    stage.run_until(Phase.ARMING, limit_s=60.0)
    for _ in range(100):
        stage.step()
    assert "ARM to drive" in stage.told[-1]
    stage.pose = np.array([-1.0, -2.0, 0.0])  # somebody knocked against it
    stage.step()
    assert stage.node.phase is Phase.PLACING
    stage.pose = np.array(START)
    stage.run_until(Phase.ARMING, limit_s=60.0)
    assert stage.sent == []  # it never armed and never lifted the car
    stage.armed = True
    stage.run_until(Phase.DONE, limit_s=60.0)
    assert set(stage.sent) == {"/arm"}  # the disarming at the end
    assert not stage.armed
    assert stage.node.outcome.stopped_early == ""
