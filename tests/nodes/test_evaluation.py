import numpy as np
import pytest

from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Path
from advnerf_core.geometry import planar_pose
from nodes.bags.writer import BagWriter
from nodes.lab.trials.evaluation import attack_ids, frames, score, timing, trajectory, why_not_shown
from nodes.runtime.messages import drive_message, encode, header, image_message, pose_message, types
from tests.support.messages import filled

pytestmark = pytest.mark.live

START_NS = 1_700_000_000_000_000_000
REASONS = ("out of view", "turned away", "turned away")
TICK_NS = 100_000_000
TRACK = Path.rounded_square(4.0, 1.1)


def write_drive(folder, lost_frame=None, speed_mps=0.8):
    """One second of driving straight along y = -2 + 0.1, one frame per tick, each handled in known times."""
    writer = BagWriter(folder / "bag", {}, {})
    sequence = 0

    def put(topic, message, at_ns):
        nonlocal sequence
        sequence += 1
        writer.write(topic, encode(message), at_ns, at_ns, sequence)

    for k in range(121):
        at_ns = START_NS + k * TICK_NS // 10
        x = -0.5 + speed_mps * k / 100
        put("/vicon/car", pose_message(planar_pose(x, -1.9, 0.0), at_ns), at_ns)
    for k in range(10):
        stamp = START_NS + k * TICK_NS
        image = np.full((4, 6, 3), k, np.uint8)
        put("/camera/image_raw", image_message(image, stamp, "camera"), stamp + 10_000_000)
        put("/compositor/image", image_message(image, stamp, "camera"), stamp + 12_000_000)
        stamped = types.AttackStamp(
            header=header(stamp), attack_id="abc", drawn=k > 2, reason="" if k > 2 else REASONS[k]
        )
        put("/compositor/attack", stamped, stamp + 12_000_000)
        put("/policy/drive", drive_message(0.8, 0.1, stamp), stamp + 20_000_000)
        put("/safety/drive", drive_message(0.8, 0.1, stamp), stamp + 21_000_000)
        sent = filled(
            types.MotorSent,
            header=header(stamp),
            serial_write_real_ns=stamp + 23_000_000,
            speed_mps=0.8,
            steering_rad=0.1,
            servo=0.5,
            braking=k == lost_frame,
            peer="TWIN",
        )
        put("/motor/sent", sent, stamp + 23_000_000)
    writer.close()
    return folder / "bag"


def test_trajectory_and_score_of_a_known_drive(tmp_path):
    horizon = Horizon(10, 0.1)
    states = trajectory(write_drive(tmp_path), START_NS, horizon)
    np.testing.assert_allclose(states[:, 0], -0.5 + 0.08 * np.arange(11), atol=1e-6)
    metrics, held = score(states, TRACK, horizon, None)
    assert metrics.total_cte_m == pytest.approx(1.0, abs=1e-5)
    assert held.shape == (11, 3)


def test_an_early_stop_holds_the_last_error(tmp_path):
    horizon = Horizon(40, 0.1)
    states = trajectory(write_drive(tmp_path), START_NS, horizon)
    metrics, held = score(states, TRACK, horizon, stopped_after_s=0.55)
    assert metrics.held_ticks == 35
    assert metrics.total_cte_m == pytest.approx(4.0, abs=1e-5)
    np.testing.assert_allclose(held[5:], np.repeat(held[5:6], 36, axis=0))


def test_a_stop_is_at_its_tick_whatever_division_makes_of_it():
    """43 x 0.1 s over 0.1 s is a little less than 43."""
    horizon, drifting = Horizon(200, 0.1), np.array([[0.0, -2.0 + 0.01 * k, 0.0] for k in range(201)])
    for tick in range(1, 200):
        metrics, held = score(drifting, TRACK, horizon, stopped_after_s=tick * 0.1)
        assert held[-1, 1] == drifting[tick, 1]
        assert metrics.max_cte_m == pytest.approx(0.01 * tick)


def test_latency_is_from_capture_to_serial_write_and_braking_is_a_missed_frame(tmp_path):
    times = timing(write_drive(tmp_path, lost_frame=4), START_NS, START_NS + 10 * TICK_NS)
    np.testing.assert_allclose(times.capture_to_serial_ms, 23.0)
    assert (times.frames, times.missed) == (10, 1)
    assert {name: float(np.median(ms)) for name, ms in times.hops_ms.items()} == {
        "camera": 10.0,
        "compositor": 12.0,
        "policy": 20.0,
        "safety": 21.0,
    }


def test_frames_and_attacks_are_those_the_policy_saw(tmp_path):
    bag = write_drive(tmp_path)
    assert [int(image[0, 0, 0]) for image in frames(bag, START_NS, 4)] == [0, 1, 2, 3]
    assert attack_ids(bag) == {"abc"}
    assert why_not_shown(bag) == "2 of 10 labels say 'turned away'"
    assert why_not_shown(bag, START_NS + 5 * TICK_NS) == "none of 5 labels says why"
