"""The expert node drives a kinematic car with delay and a wrong trim; hands and starts as the nodes see them."""

import math
from collections import deque

import numpy as np
import pytest

from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import planar_pose
from hardware.operator.hands import Hands
from nodes.collect import Start
from nodes.expert import Disturbance, ExpertNode, ExpertNodeConfig
from nodes.runtime.clock import ManualClock
from nodes.runtime.messages import pose_message, types
from nodes.runtime.wire import MessageInfo
from nodes.teleop import TeleopConfig, TeleopNode
from tests.support.messages import filled

PATH = DrivingPath.rounded_square(4.0, 1.1)
T0 = 1_700_000_000_000_000_000


class Car:
    """Poses at 100 Hz, commands obeyed after a delay, wheels that are off by a constant."""

    def __init__(self, start, delay_s=0.1, wheels_off_rad=0.0, slow=1.0, armed=True, **config):
        config = ExpertNodeConfig(room="r", vehicle="v", **config)
        self.node = ExpertNode(
            Expert(PATH, ExpertConfig(delay_s=0.0, stiffness_1pm=config.stiffness_1pm)), config
        )
        self.clock = ManualClock(mono_ns=10**10, real_ns=T0)
        self.x, self.y, self.yaw = start
        self.pipe = deque([(0.0, 0.0)] * round(delay_s / 0.01))
        self.off, self.slow, self.armed = wheels_off_rad, slow, armed
        self.command = (0.0, 0.0)
        self.states = []

    def run(self, duration_s):
        for step in range(round(duration_s / 0.01)):
            now = self.clock.now()
            info = MessageInfo(now.mono_ns, now.mono_ns, instance_id=1)
            if step % 10 == 0:
                state = filled(types.SafetyState, armed=self.armed)
                self.node.handle("/safety/state", state, info, now)
            pose = pose_message(planar_pose(self.x, self.y, self.yaw), now.real_ns)
            for topic, message in self.node.handle("/vicon/car", pose, info, now):
                if topic == "/expert/drive":
                    self.command = (message.drive.speed, message.drive.steering_angle)
                else:
                    self.states.append(message)
            self.pipe.append(self.command)
            speed, steering = self.pipe.popleft()
            speed *= self.slow
            self.yaw += 0.01 * speed * math.tan(steering + (self.off if speed else 0.0)) / 0.25
            self.x += 0.01 * speed * math.cos(self.yaw)
            self.y += 0.01 * speed * math.sin(self.yaw)
            self.clock.advance(0.01)
        return np.array([s.cte_m for s in self.states])


def test_it_comes_back_to_the_path_and_stays_there():
    cte = Car((-0.9, -2.0 + 0.3, 0.0)).run(25.0)
    assert cte[0] == pytest.approx(0.3, abs=1e-6)
    assert np.abs(cte[len(cte) // 3 :]).max() < 0.02


def test_the_integrals_take_out_wheels_and_speed_that_are_off():
    car = Car((-0.9, -2.0, 0.0), wheels_off_rad=0.03, slow=0.95, integral_radpm2=0.1)
    cte = car.run(45.0)
    without = Car((-0.9, -2.0, 0.0), wheels_off_rad=0.03, slow=0.95, integral_radpm2=0.0).run(45.0)
    assert abs(cte[-350:].mean()) < 0.25 * abs(without[-350:].mean())
    assert car.node.counters()["trim_rad"] == pytest.approx(-0.03, abs=0.015)
    assert car.states[-1].speed_mps == pytest.approx(0.8, abs=0.01)


def test_disturbances_are_declared_repeatable_and_not_in_what_it_wants():
    def drive(duration_s):
        car = Car((-0.9, -2.0, 0.0), disturb=Disturbance(steering_rad=0.2, seed=3))
        car.run(duration_s)
        return car.states

    states = drive(25.0)
    off = np.array([s.disturbance_rad for s in states])
    assert 0.05 < np.mean(off != 0.0) < 0.5
    assert (off > 0.0).any()
    assert (off < 0.0).any()
    assert np.abs(off).max() <= 0.2 + 1e-9
    cte = np.array([s.cte_m for s in states])
    assert 0.05 < np.abs(cte).max() < 0.4
    again = [s.disturbance_rad for s in drive(5.0)]
    assert any(again)
    assert again == off[: len(again)].tolist()


def test_disarmed_it_disturbs_and_integrates_nothing():
    car = Car((-0.9, -1.8, 0.0), armed=False, disturb=Disturbance())
    car.run(10.0)
    assert {s.disturbance_rad for s in car.states} == {0.0}
    assert car.node.counters()["trim_rad"] == 0.0


def test_old_poses_are_not_steered_by():
    car = Car((-0.9, -2.0, 0.0))
    now = car.clock.now()
    pose = pose_message(planar_pose(0.0, -2.0, 0.0), now.real_ns - 150_000_000)
    assert car.node.handle("/vicon/car", pose, MessageInfo(now.mono_ns, now.mono_ns), now) == []
    assert car.node.counters()["stale_poses"] == 1
    assert car.node.status()[0] == "ready"


def test_starts_lie_beside_the_path_as_declared():
    x_m, y_m, yaw_rad = Start(s_m=1.0, lateral_m=0.25, heading_rad=-0.2).pose_on(PATH)
    at = PATH.project(np.array([x_m, y_m]))
    assert (float(at.s_m), float(at.cte_m)) == (pytest.approx(1.0), pytest.approx(0.25))
    assert yaw_rad == pytest.approx(float(at.heading_rad) - 0.2)


class Hand:
    def __init__(self):
        self.clock = ManualClock(mono_ns=10**10, real_ns=T0)
        self.node = TeleopNode(TeleopConfig(), lambda: None, lambda: None)

    def does(self, **hands):
        return [(t, m) for t, m in self.node.receive(Hands(**hands), self.clock.now())]

    def tick(self, after_s=0.05):
        self.clock.advance(after_s)
        return self.node.tick(self.clock.now())

    def brakes(self, braking):
        sent = filled(types.MotorSent, servo=0.5, braking=braking, peer="TWIN")
        now = self.clock.now()
        self.node.handle("/motor/sent", sent, MessageInfo(now.mono_ns, now.mono_ns), now)

    def answer(self, ask_id, armed=True):
        now = self.clock.now()
        state = filled(
            types.SafetyState,
            armed=armed,
            source="operator",
            answered_id=ask_id,
            granted=True,
            answer="armed",
        )
        self.node.handle("/safety/state", state, MessageInfo(now.mono_ns, now.mono_ns), now)


@pytest.fixture
def hand():
    hand = Hand()
    yield hand
    hand.node.close()


def test_the_hand_goes_before_the_software_and_silence_is_letting_go(hand):
    ((_, state),) = hand.does(human=True, autonomy=True, throttle=0.5, steering=-1.0)
    assert (state.mode, state.speed_mps, state.steering_rad) == (
        "human",
        pytest.approx(0.4),
        pytest.approx(-0.25),
    )
    assert hand.tick()[0].message.mode == "human"
    assert hand.tick(0.15)[0].message.mode == "idle"
    ((_, state),) = hand.does(autonomy=True, throttle=1.0)
    assert (state.mode, state.speed_mps) == ("autonomy", 0.0)
    ((_, state),) = hand.does(autonomy=True, connected=False, text="gone")
    assert state.mode == "idle"
    assert hand.node.status() == ("fault", "gone")


def test_the_estop_stays_until_re_armed_which_is_asked_for_a_moment_later(hand):
    (_, state), (topic, stop) = hand.does(human=True, throttle=1.0, stops=1)
    assert (state.estop, state.speed_mps, topic, stop.arm) == (True, 0.0, "/arm", False)
    hand.does(stops=1)
    state, (_, repeat) = hand.tick()
    assert (state.message.estop, repeat.ask_id, repeat.arm) == (True, stop.ask_id, False)
    hand.answer(stop.ask_id, armed=False)
    assert [t for t, _ in hand.tick()] == ["/teleop/state"]
    ((_, state),) = hand.does(stops=1, rearms=1)
    assert not state.estop
    assert [t for t, _ in hand.tick() + hand.tick()] == ["/teleop/state", "/teleop/state", "/arm"]
    (_, (_, first)), (_, (_, repeat)) = hand.tick(), hand.tick()
    assert (first.ask_id, first.header, first.arm) == (repeat.ask_id, repeat.header, True)
    assert repeat.age_ns - first.age_ns == 50_000_000
    hand.answer("of another")
    assert [t for t, _ in hand.tick()] == ["/teleop/state", "/arm"]
    hand.answer(first.ask_id)
    assert [t for t, _ in hand.tick()] == ["/teleop/state"]
    hand.does(stops=2, rearms=2)  # both at once: stopping counts
    outs = hand.tick() + hand.tick()
    assert [m.arm for t, m in outs if t == "/arm"] == [False, False]
    assert hand.tick()[0].message.estop


def test_a_held_button_that_does_not_arm_the_car_says_why_once_a_press(hand, capsys):
    def hears(armed, reason):
        state, now = filled(types.SafetyState, armed=armed, reason=reason), hand.clock.now()
        hand.node.handle("/safety/state", state, MessageInfo(now.mono_ns, now.mono_ns), now)

    hears(False, "not armed: no pose of the car yet")
    hand.tick(0.4)
    assert capsys.readouterr().err == ""  # nothing is held
    for _ in range(10):
        hand.does(human=True, throttle=1.0)
        hand.tick(0.1)
    assert capsys.readouterr().err == "teleop: the car does not drive: not armed: no pose of the car yet\n"
    hears(True, "")
    hand.does(human=True, throttle=1.0)
    hand.tick(0.1)
    assert capsys.readouterr().err == ""


def test_an_estop_is_not_confirmed_until_the_motor_node_brakes(hand, capsys):
    _, (_, stop) = hand.does(stops=1)
    hand.tick(0.2)
    assert hand.node.status()[0] != "fault" or "NOT CONFIRMED" not in hand.node.status()[1]
    hand.tick(0.2)
    assert hand.node.status() == (
        "fault",
        "NOT CONFIRMED: no answer from the safety node for 0.4 s. Use the hardware stop",
    )
    hand.answer(stop.ask_id, armed=False)
    hand.tick(0.4)
    assert "the motor node does not report that it brakes" in hand.node.status()[1]
    hand.brakes(False)
    hand.tick()
    assert "NOT CONFIRMED" in hand.node.status()[1]
    hand.brakes(True)
    hand.tick()
    assert "NOT CONFIRMED" not in hand.node.status()[1]
    said = capsys.readouterr().err.splitlines()
    assert [line.split(":")[1] for line in said] == [" NOT CONFIRMED", " the car is stopped"]


def test_the_expert_drives_on_after_the_clock_was_set_back():
    """For as long as it went back, each pose had been older than the last."""
    car = Car((-0.5, -2.0, 0.0))
    car.run(1.0)
    before = len(car.states)
    now = car.clock.now()
    car.clock = ManualClock(now.mono_ns, now.real_ns - 600 * 10**9)
    car.run(1.0)
    assert len(car.states) > 1.8 * before


def test_a_pose_that_is_none_is_stale_to_the_expert():
    car = Car((-0.5, -2.0, 0.0))
    car.run(0.5)
    now = car.clock.now()
    message = pose_message(planar_pose(0.0, -2.0, 0.0), now.real_ns)
    o = message.pose.orientation
    o.x = o.y = o.z = o.w = 0.0
    assert car.node.handle("/vicon/car", message, MessageInfo(now.mono_ns, now.mono_ns), now) == []
    assert car.run(0.5).size
