"""The monitor attack as real processes on the twin: the attack reaches the lab's camera only while the car is armed."""

from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hardware.mocap.vicon import free_udp_port
from nodes.bags.reader import read_messages
from nodes.lab.trials.evaluation import attack_ids
from nodes.lab.trials.trial import TrialPlan
from nodes.lab.trials.trial_runner import run_trial
from nodes.lab.trials.tries import drive_with_tries
from nodes.runtime.messages import decode, ns_from_stamp
from nodes.runtime.pictures import rgb_image
from tests.support.faces import red_attack

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]
NODES = ("twin", "camera", "vicon", "compositor", "monitor", "policy", "safety", "motor")


@pytest.mark.slow
def test_the_lab_camera_sees_the_attack_while_armed_and_not_before(tmp_path):
    made, attack = red_attack(tmp_path, "monitor")
    overrides = [
        "policy.module=tests.support.live.straight_policy",
        "policy.speed_mps=0.5",
        f"params.calibration={ROOT / 'calibration' / 'twin'}",
        f"params.attack={attack}",
        f"params.vicon_port={free_udp_port()}",
    ]
    start = (1.95, -0.5, 0.5 * np.pi)
    launch, plan = ROOT / "launch" / "monitor.launch.yaml", TrialPlan(start, 1.5, NODES)
    drive = drive_with_tries(
        lambda: asdict(run_trial(launch, overrides, tmp_path / "run", plan, 60.0)),
        tmp_path / "run.json",
        print,
    )
    outcome = SimpleNamespace(**drive)
    bag = tmp_path / "run" / "bag"
    before, armed = [], []
    for message in read_messages(bag, ["/camera/image_raw"]):
        image = decode("sensor_msgs/msg/Image", message.cdr)
        stamp, rgb = ns_from_stamp(image.header.stamp), rgb_image(image, "test").astype(int)
        redness = (rgb[..., 0] - rgb[..., 1:].max(axis=-1) > 80).sum()
        inside = outcome.start_real_ns < stamp < outcome.end_real_ns - 2 * 10**8
        (armed if inside else before if stamp < outcome.start_real_ns - 10**9 else []).append(redness)
    # The room has some red of its own; the face is 16 px wide from where the car stands.
    assert max(before) - min(before) < 20
    assert min(armed) > max(before) + 100
    assert attack_ids(bag, ["/monitor/attack"]) == {made.attack_id}
