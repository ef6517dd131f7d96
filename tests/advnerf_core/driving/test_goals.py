"""One policy that is told where to go: several teachers, one set of frames."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.path import Arc, Line
from advnerf_core.driving.path import Path as Track
from advnerf_core.geometry import Pinhole
from advnerf_core.learning.frames import FrameStore
from advnerf_core.learning.imitation import train_policy
from advnerf_core.learning.recipe import ImitationConfig, SourcePlan, recovery_states
from advnerf_core.learning.sources import RenderedSource
from advnerf_core.policies.architecture import Architecture
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.policies.view import PolicyView

VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
TURNING = ExpertConfig(
    speed_mps=6.0,
    delay_s=0.05,
    stiffness_1pm=0.3,
    smoothing_m=0.6,
    steering_limits_rad=(-1.2, 1.2),
    output="turn_rate",
)
LEFT = Expert(
    Track.from_segments((0.0, 0.0, 0.0), [Line(4.0), Arc(10.0, 1.0), Line(10.0)], closed=False), TURNING
)
RIGHT = Expert(
    Track.from_segments((0.0, 0.0, 0.0), [Line(4.0), Arc(10.0, -1.0), Line(10.0)], closed=False), TURNING
)
CAR = Dubins(6.0, 0.1)
CONFIG = ImitationConfig(
    first_steps=3,
    round_steps=2,
    dagger_rounds=1,
    batch_size=8,
    max_steering_rad=1.2,
    architecture=Architecture(configuration={"hidden": (32, 16, 8)}),
    lateral_m=0.5,
    heading_rad=0.1,
    drive_lateral_m=0.3,
    drive_heading_rad=0.05,
    give_up_m=2.0,
    holdout_every=4,
)


def prepare(states: np.ndarray):
    """Grey bars whose places tell x, y and yaw; both teachers' poses look alike, only the goal tells them apart."""
    columns = torch.arange(200.0)
    images = torch.full((len(states), 3, 66, 200), 0.2)
    for image, (x, y, yaw) in zip(images, states, strict=True):
        for channel, place in enumerate((10.0 + 7.0 * x, 100.0 + 8.0 * y, 100.0 + 60.0 * yaw)):
            image[channel] += 0.7 * torch.exp(-(((columns - place) / 12.0) ** 2))
    return lambda texture: images


def plans(stills: int = 12, drives: int = 2) -> list[SourcePlan]:
    told = (("left", (1.0, 0.0), LEFT), ("right", (0.0, 1.0), RIGHT))
    return [
        SourcePlan(
            RenderedSource(name, prepare, CAR),
            stills,
            drives,
            drive_steps=4,
            goal=goal,
            expert=expert,
            driven_m=8.0,
        )
        for name, goal, expert in told
    ]


def test_turn_rate_keeps_a_dubins_car_on_its_path() -> None:
    states = torch.tensor([[0.0, 0.4, 0.05], [0.0, -0.4, -0.05]], dtype=torch.float64)
    errors = []
    for _ in range(35):
        states = CAR.step(states, torch.from_numpy(LEFT.steer_states(states.numpy())))
        errors.append(LEFT.path.project(states[:, :2].numpy()).cte_m)
    assert np.abs(errors).max() < 0.5
    assert np.abs(errors[-1]).max() < 0.05
    # On the arc and without error the turn rate is speed over radius.
    assert float(LEFT.steer(*LEFT.path.pose_at(9.0))) == pytest.approx(6.0 / 10.0, rel=1e-6)


def test_expert_of_a_steered_car_is_described_as_before() -> None:
    assert "output" not in Expert(LEFT.path).to_dict()
    assert LEFT.to_dict()["output"] == "turn_rate"
    with pytest.raises(ValueError, match="wheel_angle or turn_rate"):
        ExpertConfig(output="torque")  # type: ignore[arg-type]


def test_poses_stay_on_the_driven_part() -> None:
    states = recovery_states(LEFT.path, 200, np.random.default_rng(0), 0.2, 0.1, driven_m=6.0)
    along = LEFT.path.project(states[:, :2]).s_m
    assert 5.0 < along.max() < 6.1


def test_each_goal_is_taught_by_its_own_expert(tmp_path: Path) -> None:
    result = train_policy(CONFIG, plans(), LEFT, VIEW, tmp_path)
    assert load_policy(result.path).policy.goal_size == 2
    store = FrameStore(tmp_path / "frames")
    assert store.names() == ["drive0-left", "drive0-right", "stills-left", "stills-right"]
    for name, goal, expert in (("stills-left", [1.0, 0.0], LEFT), ("drive0-right", [0.0, 1.0], RIGHT)):
        frames = store.load(name)
        assert (frames.goals == goal).all()
        np.testing.assert_allclose(frames.steering_rad, expert.steer_states(frames.states), rtol=1e-6)
    assert train_policy(CONFIG, plans(), LEFT, VIEW, tmp_path).sha256 == result.sha256
    assert json.loads((tmp_path / "settings.json").read_text())["settings"]["plans"][1]["goal"] == [0.0, 1.0]


@pytest.mark.slow
def test_one_policy_learns_both_turns(tmp_path: Path) -> None:
    learning = replace(CONFIG, first_steps=200, dagger_rounds=0, batch_size=32, architecture=Architecture())
    policy = load_policy(train_policy(learning, plans(128), LEFT, VIEW, tmp_path).path).policy
    image = prepare(np.array([[7.0, 0.0, 0.0]]))(None)
    with torch.no_grad():
        left, right = (float(policy(image, torch.tensor([goal]))[0]) for goal in ((1.0, 0.0), (0.0, 1.0)))
    assert left > 0.2
    assert right < -0.2


def test_a_goal_weighs_something_from_the_start() -> None:
    torch.manual_seed(0)
    told, image = PilotNet(2, 1.2), prepare(np.array([[7.0, 0.0, 0.0]]))(None)
    with torch.no_grad():
        hidden = [
            told.head[0](torch.cat([told.features(image * 2.0 - 1.0), torch.tensor([g])], 1))
            for g in ((1.0, 0.0), (0.0, 1.0))
        ]
    # The features alone spread the hidden units by about 0.3; the goal must be as loud.
    assert (hidden[0] - hidden[1]).std() > 0.15


def test_goals_of_different_lengths_are_refused(tmp_path: Path) -> None:
    first, second = plans()
    with pytest.raises(ValueError, match="goals of one length"):
        train_policy(CONFIG, [first, replace(second, goal=(1.0,))], LEFT, VIEW, tmp_path)
    assert second.settings().keys() == {
        "source",
        "stills",
        "drives",
        "drive_steps",
        "goal",
        "expert",
        "driven_m",
    }
    plain = replace(second, goal=(), expert=None, driven_m=None)
    assert plain.settings().keys() == {"source", "stills", "drives", "drive_steps"}
