"""Counterfactual steering as it is recorded: the green screen's graph on the twin, one process per node, one drive past an attack."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy, save_policy
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, RoomCalibration, load_calibration
from hardware.mocap.vicon import free_udp_port
from nodes.bags.reader import read_messages
from nodes.lab.trials.evaluation import counterfactual
from nodes.lab.trials.trial import TrialOutcome, TrialPlan
from nodes.lab.trials.trial_runner import run_trial
from nodes.lab.trials.tries import drive_with_tries
from nodes.runtime.messages import decode, ns_from_stamp
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import topic as topic_row
from tests.support.faces import red_attack

ROOT = Path(__file__).parents[2]
TWIN = ROOT / "calibration" / "twin"
NODES = ("twin", "camera", "vicon", "compositor", "policy", "counterfactual", "safety", "motor", "recorder")
CLEAN, ATTACKED, LABEL = "/camera/image_raw", "/compositor/image", "/compositor/attack"
SAID, COMMAND, STATUS = "/policy/counterfactual", "/policy/drive", "/status/counterfactual"
SECONDS = 3.0

pytestmark = [pytest.mark.live, pytest.mark.slow]


@dataclass(frozen=True)
class Recorded:
    """What one drive left.

    Attributes:
        bag: Its bag.
        outcome: When it began and ended.
        attack_id: What was shown.
        policy: Who drove.
    """

    bag: Path
    outcome: TrialOutcome
    attack_id: str
    policy: Path

    def messages(self, topic: str) -> dict[int, Any]:
        """What was said on a topic, by the stamp of the image that it is about [ns]; nothing is said twice."""
        decoded = [decode(topic_row(topic).type, message.cdr) for message in read_messages(self.bag, [topic])]
        by_stamp = {ns_from_stamp(message.header.stamp): message for message in decoded}
        assert len(by_stamp) == len(decoded)
        return by_stamp

    def driving(self, stamp_ns: int) -> bool:
        """Whether an image was taken while the car drove."""
        return self.outcome.start_real_ns <= stamp_ns < self.outcome.end_real_ns


def untrained(folder: Path) -> Path:
    """A policy that goes gently to the left, and whose steering depends on what it sees by about a degree."""
    torch.manual_seed(0)
    network, camera = PilotNet(), load_calibration(CameraCalibration, TWIN / "camera.yaml")
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.5)  # as it is, it answers everything with nearly the same
    save_policy(
        folder / "policy.safetensors", network, PolicyView(camera.pinhole, distortion=camera.distortion), {}
    )
    return folder / "policy.safetensors"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("counterfactual")
    policy, attack = untrained(folder), red_attack(folder, "board")[0]
    overrides = [
        "params.counterfactual=true",
        f"params.calibration={TWIN}",
        f"params.policy={policy}",
        "policy.speed_mps=0.5",
        f"params.attack={folder / 'red.attack.safetensors'}",
        f"params.vicon_port={free_udp_port()}",
    ]
    start = load_calibration(RoomCalibration, TWIN / "room.yaml").start_pose
    plan = TrialPlan(start, SECONDS, NODES)

    def drive() -> dict[str, Any]:
        launch = ROOT / "launch" / "green_screen.launch.yaml"
        return asdict(run_trial(launch, overrides, folder / "drive", plan, 120.0))

    outcome = drive_with_tries(drive, folder / "drive.json", print)
    outcome.pop("spoiled")
    return Recorded(folder / "drive" / "bag", TrialOutcome(**outcome), attack.attack_id, policy)


def steering(policy: Path, images: list[Any]) -> list[float]:
    """What the network itself makes of recorded images [rad]."""
    loaded = load_policy(policy)
    with torch.no_grad():
        views = [images_to_tensor(loaded.view.image(rgb_image(image, "test"))) for image in images]
        return [float(loaded.policy(view)[0]) for view in views]


def test_every_command_of_the_drive_has_its_comparison_or_is_counted(recorded: Recorded) -> None:
    said, commands = recorded.messages(SAID), recorded.messages(COMMAND)
    driven = {stamp for stamp in commands if recorded.driving(stamp)}
    assert len(driven) >= 0.8 * 10 * SECONDS
    *_, last = (
        decode(topic_row(STATUS).type, message.cdr) for message in read_messages(recorded.bag, [STATUS])
    )
    counted = dict(zip(last.counter_names, last.counter_values, strict=True))
    left_out = sum(
        count
        for name, count in counted.items()
        if name.startswith(("dropped", "lost", "without_partner", "inbox"))
    )
    assert len(driven - said.keys()) <= left_out
    assert len(driven & said.keys()) >= 10
    assert said.keys() <= recorded.messages(ATTACKED).keys()


def test_both_steerings_are_the_networks_own_on_the_recorded_images(recorded: Recorded) -> None:
    said, clean, attacked = (recorded.messages(topic) for topic in (SAID, CLEAN, ATTACKED))
    for of, images in (("clean_rad", clean), ("attacked_rad", attacked)):
        expected = steering(recorded.policy, [images[stamp] for stamp in said])
        assert [getattr(word, of) for word in said.values()] == pytest.approx(expected, abs=1e-5)
    assert {word.policy_sha256 for word in said.values()} == {load_policy(recorded.policy).sha256}


def test_the_attack_adds_something_while_it_is_drawn_and_nothing_else_ever(recorded: Recorded) -> None:
    said, labels = recorded.messages(SAID), recorded.messages(LABEL)
    clean, attacked = recorded.messages(CLEAN), recorded.messages(ATTACKED)
    drawn = [stamp for stamp, word in said.items() if word.drawn]
    plain = [stamp for stamp, word in said.items() if not word.drawn]
    assert min(len(drawn), len(plain)) >= 5
    assert all(said[stamp].drawn is bool(labels[stamp].drawn) for stamp in said)
    for stamp, word in said.items():
        assert word.delta_rad == word.attacked_rad - word.clean_rad
        assert (
            np.array_equal(rgb_image(clean[stamp], "test"), rgb_image(attacked[stamp], "test"))
            is not word.drawn
        )
    assert all(said[stamp].delta_rad == said[stamp].changed == 0.0 for stamp in plain)
    # A red board changes the steering by a degree or so, once to the left and once to the right, and some of what the policy sees.
    assert all(said[stamp].delta_rad != 0.0 for stamp in drawn)
    assert np.abs([said[stamp].delta_rad for stamp in drawn]).mean() > 0.005
    assert all(
        0.02 < said[stamp].changed < 0.5 and said[stamp].attack_id == recorded.attack_id for stamp in drawn
    )
    # Before the car is armed and after it is disarmed the interlock leaves the images alone.
    before = [stamp for stamp in plain if stamp < recorded.outcome.start_real_ns]
    assert before
    assert not [stamp for stamp in drawn if stamp > recorded.outcome.end_real_ns + 10**9]
    found = counterfactual(recorded.bag, recorded.outcome.start_real_ns, recorded.outcome.end_real_ns)
    assert found is not None
    assert found.frames_drawn == sum(recorded.driving(stamp) for stamp in drawn)


def test_the_car_drives_by_the_attacked_image(recorded: Recorded) -> None:
    said, attacked = recorded.messages(SAID), recorded.messages(ATTACKED)
    commands = {
        stamp: m.drive.steering_angle for stamp, m in recorded.messages(COMMAND).items() if stamp in attacked
    }
    assert len(commands) >= 10
    expected = steering(recorded.policy, [attacked[stamp] for stamp in commands])
    assert list(commands.values()) == pytest.approx(expected, abs=1e-5)
    both = [stamp for stamp in commands if stamp in said and said[stamp].drawn]
    driven, by_attacked, by_clean = np.array(
        [(commands[stamp], said[stamp].attacked_rad, said[stamp].clean_rad) for stamp in both]
    ).T
    assert driven == pytest.approx(by_attacked, abs=1e-6)
    assert np.abs(driven - by_clean).mean() > 0.005
