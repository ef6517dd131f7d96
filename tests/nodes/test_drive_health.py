"""Which drives count: planted bags and stops of the real checks, in both directions. No rule may read where the car was."""

import json

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from hardware.motor.vesc_replies import Values
from nodes.bags.writer import BagWriter
from nodes.control.arming_gates import HandGate
from nodes.control.stop_causes import is_result, is_stall
from nodes.lab.trials.drive_health import DriveHealth, read_health, spoiled_by
from nodes.lab.trials.trial import SpoiledError
from nodes.lab.trials.tries import MOST_TRIES, NotDrivenError, allow_more_tries, drive_with_tries
from nodes.runtime.messages import encode, header, pose_message, types
from tests.nodes.test_arming import World
from tests.support.messages import filled

START_NS, TICK_S, TICKS = 1_700_000_000_000_000_000, 0.1, 60
STALL = "stalled for 1.0 s: commanded 0.80 m/s, the car does not move"


def sent(stamp_ns, age_s, braking=False):
    return filled(
        types.MotorSent,
        header=header(stamp_ns),
        serial_write_real_ns=stamp_ns + round(age_s * 1e9),
        speed_mps=0.8,
        servo=0.5,
        braking=braking,
        peer="TWIN",
    )


def status(node, real_ns, **counters):
    return filled(
        types.NodeStatus,
        header=header(real_ns),
        node=node,
        pid=1,
        state="active",
        counter_names=list(counters),
        counter_values=np.array(list(counters.values()), float),
    )


def write_bag(folder, served=(), age_s=0.05, missed_per_s=0.0, offset_m=0.0):
    """A drive of six seconds: commands from the images of some ticks, the loop of one node, poses beside the path."""
    rows = [
        (START_NS + round(k * TICK_S * 1e9), "/motor/sent", sent(START_NS + round(k * TICK_S * 1e9), age_s))
        for k in served
    ]
    for k in range(30):
        at_ns = START_NS + k * 200_000_000
        done, missed = 20 * 0.2 * k, missed_per_s * 0.2 * k
        rows.append(
            (at_ns, "/status/compositor", status("compositor", at_ns, ticks=done, ticks_missed=missed))
        )
        rows.append((at_ns, "/vicon/car", pose_message(planar_pose(0.16 * k, offset_m, 0.0), at_ns)))
    with BagWriter(folder) as writer:
        for number, (at_ns, topic, message) in enumerate(sorted(rows, key=lambda row: row[0])):
            writer.write(topic, encode(message), at_ns, at_ns, number)
    return folder


def judged(bag, stopped="", seconds=TICKS * TICK_S):
    return spoiled_by(read_health(bag, START_NS, START_NS + round(seconds * 1e9), stopped, TICK_S))


ALL = range(TICKS)


@pytest.mark.parametrize(
    ("bag", "words"),
    [
        ({"served": ALL}, ""),
        ({"served": [k for k in ALL if k % 12]}, ""),  # one image in twelve is lost
        ({"served": ALL, "age_s": 0.19}, ""),
        ({"served": ALL, "missed_per_s": 2.0}, ""),
        ({"served": [k for k in ALL if k % 5]}, "12 of 59 control ticks had no new command; at most 5 may"),
        ({"served": []}, "59 of 59 control ticks had no new command"),
        ({"served": ALL, "age_s": 0.21}, "59 of 59 commands were older than 0.2 s"),
        ({"served": ALL, "missed_per_s": 20.0}, "node compositor missed 50 % of its ticks; at most 25 %"),
    ],
)
def test_timing_and_loops_decide_whether_a_drive_counts(tmp_path, bag, words):
    found = judged(write_bag(tmp_path / "bag", **bag))
    assert found.startswith(words) if words else found == ""


@pytest.mark.parametrize("rate_hz", [10, 30])
def test_a_faster_camera_makes_up_for_no_pause_and_may_have_as_many_late_commands(tmp_path, rate_hz):
    """In each 0.4 s the commands pause for 0.2 s; in another drive, one of 25 is late."""
    every = np.arange(6 * rate_hz) / rate_hz / TICK_S
    paused = judged(
        write_bag(tmp_path / "paused", [k for k in every if round(k * TICK_S, 6) % 0.4 < 0.2 - 1e-6])
    )
    assert "control ticks had no new command" in paused
    with BagWriter(tmp_path / "late") as writer:
        for number, tick in enumerate(every):
            at_ns = START_NS + round(tick * TICK_S * 1e9)
            message = sent(at_ns, 0.25 if number % 25 == 0 else 0.05)
            writer.write("/motor/sent", encode(message), at_ns, at_ns, number)
    assert judged(tmp_path / "late") == ""


@pytest.mark.parametrize("served", [ALL, [k for k in ALL if k % 3]])
def test_the_verdict_does_not_depend_on_where_the_car_drove(tmp_path, served):
    verdicts = {
        judged(write_bag(tmp_path / f"bag{number}", served, offset_m=offset_m))
        for number, offset_m in enumerate((0.0, 0.39, 3.0))
    }
    assert len(verdicts) == 1


@pytest.mark.parametrize(
    "stopped",
    ["the car is outside the fence, at (3.60, 0.00) m", STALL, "disarmed by operator: from a terminal"],
)
@pytest.mark.parametrize("seconds", [0.5, 2.0, 5.9])
def test_a_drive_that_the_attack_or_a_person_ended_is_a_result_at_any_time(tmp_path, stopped, seconds):
    assert judged(write_bag(tmp_path / "bag", ALL), stopped, seconds) == ""


def test_a_stop_by_silence_is_no_result_in_a_drive_that_was_timely(tmp_path):
    found = judged(write_bag(tmp_path / "bag", ALL), "no pose of the car for 0.21 s", 5.0)
    assert found == "the stack stopped the car: no pose of the car for 0.21 s"


@pytest.mark.parametrize(
    ("skipped", "words"),
    [(0, ""), (3, "; the simulated camera skipped 3 of its pictures: this machine is too slow")],
)
def test_a_stop_by_silence_names_a_camera_that_is_too_slow(tmp_path, skipped, words):
    with BagWriter(tmp_path / "bag") as writer:
        for number, count in enumerate((5, 5 + skipped)):
            at_ns = START_NS + number * 700_000_000  # the second after the end
            message = status("twin", at_ns, **{"missed camera": count})
            writer.write("/status/twin", encode(message), at_ns, at_ns, number)
    stop = "no command from the policy for 0.22 s"
    found = judged(tmp_path / "bag", stop, 0.5)
    assert found.startswith(f"the stack stopped the car: {stop}{words}")
    assert bool(words) == ("camera" in found)


def test_a_result_does_not_hide_a_graph_that_was_too_slow(tmp_path):
    """An attack that seems to work because every second command is missing is no result."""
    slow = write_bag(tmp_path / "bag", [k for k in ALL if k % 2])
    assert judged(slow, "the car is outside the fence, at (3.60, 0.00) m").startswith(
        "30 of 59 control ticks"
    )


def test_a_short_drive_may_lack_one_command():
    assert spoiled_by(DriveHealth("", ticks=4, unserved=1)) == ""
    assert spoiled_by(DriveHealth("", ticks=4, unserved=2)) != ""


def stopped(change):
    """The reason of the real checks after a change of a driving world."""
    world = World()
    world.run(1000)
    assert world.arm()
    world.run(300)
    change(world)
    world.run(3000)
    assert not world.arming.armed
    return world.arming.reason


def set_to(**changes):
    def change(world):
        for name, value in changes.items():
            setattr(world, name, value)

    return change


@pytest.mark.parametrize(
    ("change", "result"),
    [
        (set_to(xy=(3.6, 0.0)), True),
        (set_to(command=(0.8, 0.7)), True),  # the policy's answer to an image
        (set_to(command=(float("nan"), 0.0)), True),
        (lambda world: world.arming.disarm("disarmed by operator: enough", world.ms * 1_000_000), True),
        *[(set_to(silent={name}), False) for name in ("camera", "vicon", "policy", "compositor", "motor")],
        (set_to(states={"camera": "active", "motor": "fault"}), False),
        (set_to(capture_frozen_at=50_000), False),
        (set_to(instances={"policy": 2}), False),
    ],
)
def test_the_reasons_of_the_real_checks_are_told_apart(change, result):
    def complete(world):
        states = dict(world.states)
        change(world)
        world.states = {**states, **world.states}

    reason = stopped(complete)
    assert is_result(reason) is result, reason


@pytest.mark.parametrize(("fault", "result"), [(4, True), (1, False), (5, False), (15, False)])
def test_a_fault_of_the_motor_controller_is_a_result_if_the_car_ran_into_something(fault, result):
    """The texts of the motor node's latch and of the safety node, from the fault code on the wire."""
    values = Values("A", *[0.0] * 5, 0, 0, fault, *[0.0] * 4)
    text = f"latched: the VESC reports a fault: {values.fault_name}"

    def faulty(world):
        world.states = {**world.states, "motor": "fault"}
        world.texts = {"motor": text}

    reason = stopped(faulty)
    assert text in reason
    assert is_result(reason) is result, reason


def test_stalls_and_hands_are_told_apart():
    assert is_stall(STALL)
    assert is_result(STALL)
    hand = HandGate(required=True)
    assert not is_result(hand.problem(0))  # no message of the teleop node
    hand.pressed_stop = True
    assert is_result(hand.problem(0))


def test_spoiled_tries_are_kept_and_a_drive_is_tried_three_times_in_all(tmp_path):
    file, told, left = tmp_path / "live0.json", [], ["late", "late again"]

    def drive():
        assert not (tmp_path / "live0").exists()
        (tmp_path / "live0").mkdir()
        if left:
            raise SpoiledError(left.pop(0))
        return {"total": 1.0}

    found = drive_with_tries(drive, file, told.append)
    assert found == {"total": 1.0, "spoiled": ["late", "late again"]} == json.loads(file.read_text())
    assert told == [
        "live0 does not count: late (try 1 of 3)",
        "live0 does not count: late again (try 2 of 3)",
    ]
    assert drive_with_tries(lambda: pytest.fail("driven twice"), file, told.append) == found


def test_an_interrupted_drive_has_no_more_tries_than_another(tmp_path):
    file, count = tmp_path / "live0.json", []

    def drive():
        count.append(1)
        if len(count) == 2:
            raise KeyboardInterrupt
        raise SpoiledError(f"late {len(count)}")

    with pytest.raises(KeyboardInterrupt):
        drive_with_tries(drive, file, lambda text: None)
    for _ in range(2):
        with pytest.raises(NotDrivenError, match="live0 was spoiled 3 times, at last: late 4") as caught:
            drive_with_tries(drive, file, lambda text: None)
        assert caught.value.spoiled == ("late 1", "late 3", "late 4")
        assert len(count) == MOST_TRIES + 1  # the interrupted one found nothing
    assert not file.exists()
    assert not (tmp_path / "live0").exists()  # nobody takes its bag for that of a drive
    allow_more_tries(tmp_path)
    kept = drive_with_tries(lambda: {"total": 1.0}, file, lambda text: None)
    assert kept["spoiled"] == ["late 1", "late 3", "late 4"]
