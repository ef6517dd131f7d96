"""The monitor attack as real processes on the twin: the attack reaches the lab's camera only while the car is armed."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from advnerf_core.attack.artifact import AttackFile, save_attack
from advnerf_core.geometry import Pinhole
from calibration.panel import centre_square
from calibration.schema import TargetCalibration, load_calibration
from nodes.bags.reader import read_messages
from nodes.lab.trials.evaluation import attack_ids
from nodes.lab.trials.trial import TrialPlan
from nodes.lab.trials.trial_runner import run_trial
from nodes.lab.trials.tries import drive_with_tries
from nodes.runtime.messages import decode, ns_from_stamp
from nodes.runtime.pictures import rgb_image

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]
NODES = ("twin", "camera", "vicon", "compositor", "monitor", "policy", "safety", "motor")


def red_attack(folder):
    target = load_calibration(TargetCalibration, ROOT / "calibration" / "twin" / "monitor.yaml")
    attack = AttackFile.of_face(
        method="random",
        theta=np.zeros((4, 4, 3), np.float32),
        texture=np.full((64, 64, 3), (250, 0, 0), np.uint8),
        size_m=(0.3362, 0.3362),
        T_world_from_object=np.eye(4),
        subject="monitor",
        corners_in_subject=centre_square(target).corners,
        camera=Pinhole(200, 66, 103.6, 103.4, 100, 32),
        scene_sha256="",
        policy_sha256="",
        config_sha256="",
        seed=0,
        predicted_total_cte_m=None,
        software_version="0",
    )
    save_attack(folder / "red.attack.safetensors", attack)
    return attack.attack_id, folder / "red.attack.safetensors"


@pytest.mark.slow
def test_the_lab_camera_sees_the_attack_while_armed_and_not_before(tmp_path):
    attack_id, attack = red_attack(tmp_path)
    overrides = [
        "policy.module=tests.support.live.straight_policy",
        "policy.speed_mps=0.5",
        f"params.calibration={ROOT / 'calibration' / 'twin'}",
        f"params.attack={attack}",
        "params.vicon_port=52801",
    ]
    start = (1.95, -0.5, 0.5 * np.pi)
    launch, plan = ROOT / "launch" / "monitor.launch.yaml", TrialPlan(start, 1.5, NODES)
    drive = drive_with_tries(
        lambda: run_trial(launch, overrides, tmp_path / "run", plan, 60.0).to_dict(),
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
    assert attack_ids(bag, ["/monitor/attack"]) == {attack_id}
