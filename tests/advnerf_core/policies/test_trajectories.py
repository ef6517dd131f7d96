"""Policies that answer with waypoints steer as a pure pursuit tracker does."""

import numpy as np
import pytest
import torch

from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.load import load_driver
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.tracker import TrackedTrajectory, pursued_curvature_1pm
from tests.support.onnx_models import VIEW

WHEELBASE_M, LOOKAHEAD_M = 0.3, 0.4
TRACKED = TrackedTrajectory(times_s=(0.5, 1.0, 1.5), lookahead_m=LOOKAHEAD_M, wheelbase_m=WHEELBASE_M)


def arc(radius_m, along_m):
    """Points of a circle to the left that starts ahead."""
    turn = along_m / radius_m
    return np.column_stack([radius_m * np.sin(turn), radius_m * (1.0 - np.cos(turn))])


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_the_arc_through_waypoints_is_that_of_the_circle_they_lie_on(kind):
    def curvature(points, lookahead_m=LOOKAHEAD_M):
        return float(pursued_curvature_1pm(kind(np.asarray(points)[None]), lookahead_m)[0])

    along_m = np.linspace(0.01, 1.0, 200)
    for radius_m in (0.7, 2.0, 50.0):
        left = arc(radius_m, along_m)
        assert curvature(left) == pytest.approx(1.0 / radius_m, rel=1e-3)
        assert curvature(left * [1.0, -1.0]) == pytest.approx(-1.0 / radius_m, rel=1e-3)
    # Coarse waypoints are met between two of them: where the line from (0.2, 0) to (0.6, 0.3) is 0.4 m away.
    share = (-0.16 + np.sqrt(0.16**2 + 0.5**2 * 4 * 0.12)) / (2 * 0.25)  # 0.25 s^2 + 0.16 s - 0.12 = 0
    x, y = 0.2 + 0.4 * share, 0.3 * share
    assert np.hypot(x, y) == pytest.approx(0.4)
    assert curvature([[0.2, 0.0], [0.6, 0.3]]) == pytest.approx(2 * y / 0.16)
    assert curvature([[0.1, 0.05]]) == pytest.approx(2 * 0.05 / 0.0125), "the end of short ones"
    assert curvature([[0.0, 0.0]]) == 0.0
    assert curvature([[0.0, 0.0], [0.3, 0.1], [0.3, 0.1]]) == pytest.approx(2 * 0.1 / 0.1), (
        "points that repeat"
    )


def test_the_gradient_through_the_tracker_agrees_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    steps = torch.rand(24, 5, 2, generator=generator, dtype=torch.float64) * torch.tensor([0.2, 0.1])
    points = (steps.cumsum(1) - torch.tensor([0.0, 0.2])).requires_grad_()
    short = (points.detach().norm(dim=-1).max(1).values < LOOKAHEAD_M).sum()
    assert 2 < short < 22, "trajectories that are long enough, and such that are not"
    assert torch.autograd.gradcheck(lambda given: pursued_curvature_1pm(given, LOOKAHEAD_M), points)


class Plans(torch.nn.Module):
    """Waypoints on a straight line; the brighter the picture, the farther to the left."""

    def forward(self, images):
        side = images.mean((1, 2, 3))[:, None] - 0.3
        ahead = torch.tensor([0.3, 0.6, 0.9])
        return torch.stack([ahead + 0.0 * side, side * ahead], dim=2)


def steered(grey):
    """The wheel angle for `Plans` in closed form: the point 0.4 m away on the line of slope ``grey - 0.3``."""
    angle = np.arctan(grey - 0.3)
    return np.arctan(WHEELBASE_M * 2.0 * np.sin(angle) / LOOKAHEAD_M)


def pictures(grey):
    return torch.full((1, 3, *VIEW.image(np.zeros((8, 12, 3), np.uint8)).shape[:2]), grey)


@pytest.mark.parametrize(
    "reshaped", [lambda raw: raw, lambda raw: raw.flatten(1), lambda raw: torch.cat([raw, raw], 2)]
)
def test_a_policy_of_waypoints_steers_to_them(reshaped):
    plans = Plans()
    policy = adapt(lambda images: reshaped(plans(images)), PolicyContract(VIEW, trajectory=TRACKED))
    for grey in (0.1, 0.5, 0.9):
        assert float(policy(pictures(grey))[0]) == pytest.approx(steered(grey), abs=1e-6)
    image = pictures(0.6).double().requires_grad_()
    (slopes,) = torch.autograd.grad(policy(image).sum(), image)
    assert float(slopes.sum()) == pytest.approx((steered(0.6 + 1e-5) - steered(0.6 - 1e-5)) / 2e-5, rel=1e-5)


def test_a_car_that_is_told_a_turn_rate_is_turned_along_the_same_arc():
    tracked = {"times_s": [0.5, 1.0, 1.5], "lookahead_m": LOOKAHEAD_M, "car_speed_mps": 7.0}
    policy = adapt(Plans(), PolicyContract(VIEW, trajectory=tracked))
    curvature_1pm = np.tan(steered(0.6)) / WHEELBASE_M
    assert float(policy(pictures(0.6))[0]) == pytest.approx(7.0 * curvature_1pm, rel=1e-6)


def test_the_live_node_follows_the_waypoints_of_a_file_without_torch(tmp_path):
    file = tmp_path / "plans.onnx"
    contract = PolicyContract(VIEW, trajectory=TRACKED, positive="right")
    export_onnx(Plans().eval(), contract, file)
    driver = load_driver(file)
    assert driver.contract.trajectory == TRACKED
    raw = driver.answer(np.full((8, 12, 3), 255, np.uint8), ())
    assert isinstance(raw, np.ndarray)
    assert contract.trajectory.speed_mps(contract.waypoints_m(raw, 1))[0] == pytest.approx(
        0.9 * np.hypot(1.0, 0.7) / 1.5
    )
    assert driver.steer(np.full((8, 12, 3), 255, np.uint8), ()) == pytest.approx(-steered(1.0), abs=1e-6)


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({"times_s": [1.0, 0.5]}, "times_s must increase"),
        ({"times_s": []}, "times_s"),
        ({"lookahead_m": 0.0}, "lookahead_m.*greater than 0"),
        ({"car_speed_mps": 7.0}, "give one of them"),
        ({"wheelbase_m": None}, "give one of them"),
        ({"lookahead": 1.0}, "unknown key lookahead|lookahead: extra"),
    ],
)
def test_a_wrong_trajectory_is_one_error(declared, message):
    given = {"times_s": [0.5, 1.0], "lookahead_m": 0.4, "wheelbase_m": 0.3, **declared}
    with pytest.raises(PolicyContractError, match=message):
        PolicyContract.from_dict({"view": VIEW.to_dict(), "trajectory": given})


def test_an_output_of_another_kind_is_refused():
    policy = adapt(lambda images: images.mean((1, 2, 3)), PolicyContract(VIEW, trajectory=TRACKED))
    with pytest.raises(
        PolicyContractError, match=r"trajectory.times_s: expected an output of \[1, 3, 2\], got \[1\]"
    ):
        policy(pictures(0.5))
    with pytest.raises(
        PolicyContractError, match="output_unit, steering_ratio: expected neither with a trajectory"
    ):
        PolicyContract(VIEW, trajectory=TRACKED, output_unit="deg")
    with pytest.raises(
        PolicyContractError, match="expected an output of one kind, got output_column and trajectory"
    ):
        PolicyContract(VIEW, trajectory=TRACKED, output_column=1)
