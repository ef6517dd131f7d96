"""Objectives: values and losses against their formulas, gradients against differences, and the searches that follow them."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.special import expit, logsumexp
from scipy.stats import spearmanr

from advnerf_core.attack.adjoint import adjoint_gradient, evaluate
from advnerf_core.attack.methods import METHODS, SearchRun, SearchSettings
from advnerf_core.attack.objective import (
    Collision,
    CrossTrackError,
    DriftLeft,
    DriftRight,
    JudgedDrives,
    Objective,
    ObjectiveError,
    Peak,
    RunWide,
    TimeOffTrack,
    loss_slopes,
    losses_of,
    values_of,
)
from advnerf_core.attack.objectives import OBJECTIVES, load_objective, objective_key
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Arc, Line, Path
from advnerf_core.driving.solids import Rectangle, Solids
from advnerf_core.plugins import PluginError, name_in_results
from benchmarks.adjoint_gradient import backpropagated_gradient, finite_difference, relative_error
from tests.support.attack_toy import toy_problem

ROAD = Path.from_segments((0.0, 0.0, 0.0), [Line(50.0)], closed=False)  # its CTE is y
BENT = Path.from_segments((0.0, 0.0, 0.0), [Line(1.0), Arc(3.0, -1.2)], closed=False)
TICKS, LIMITS = 40, Horizon(40, 0.1, 0.4, 1.5)
SOLIDS = Solids(
    (Rectangle(2.0, 1.2, 0.4, 0.3, 0.4), Rectangle(2.6, -1.3, 0.5, 0.3)), Rectangle(0.13, 0.0, 0.25, 0.15)
)
LEFT = "from advnerf_core.attack.objective import Objective\n\nclass Left(Objective):\n    def value(self, drives):\n        return drives.cte_m.clamp(min=0.0).sum(0)\n"


def random_drives(count: int, seed: int = 0, road: Path = ROAD, **others) -> JudgedDrives:
    """Drives of a car whose turn rate wanders, some straight and some far off."""
    generator = torch.Generator().manual_seed(seed)
    car, states = Dubins(0.8, 0.1), [torch.zeros(count, 3, dtype=torch.float64)]
    states[0][:, 1:] = 0.05 * torch.randn(count, 2, generator=generator, dtype=torch.float64)
    bias, noise = (torch.randn(n, count, generator=generator, dtype=torch.float64) for n in (1, TICKS))
    for tick in range(TICKS):
        states.append(car.step(states[-1], 0.25 * bias[0] + 0.3 * noise[tick]))
    return JudgedDrives(torch.stack(states), road, LIMITS, solids=SOLIDS, **others)


def road_of(objective: str) -> Path:
    """A road on which an objective is defined."""
    return BENT if objective == "run_wide" else ROAD


@pytest.mark.parametrize("name", OBJECTIVES)
def test_the_gradient_of_a_loss_is_that_of_central_differences(name):
    objective, drives = load_objective(name), random_drives(4, road=road_of(name))
    loss, slopes = loss_slopes(objective, drives)
    assert loss == pytest.approx(float(losses_of(objective, drives).mean()), rel=1e-12)
    generator = torch.Generator().manual_seed(2)
    for _ in range(4):
        along = torch.randn(slopes.shape, generator=generator, dtype=torch.float64)
        ends = [
            dataclasses.replace(drives, states=drives.states + sign * 1e-6 * along) for sign in (1.0, -1.0)
        ]
        high, low = (float(losses_of(objective, each).mean()) for each in ends)
        assert float((slopes * along).sum()) == pytest.approx((high - low) / 2e-6, rel=1e-5, abs=1e-7)
    assert float(slopes[1:].abs().max()) > 1e-3
    assert not slopes[0].any()


@pytest.mark.parametrize("name", OBJECTIVES)
def test_a_loss_ranks_drives_as_its_value_does(name):
    objective, drives = load_objective(name), random_drives(300, seed=5, road=road_of(name))
    values, losses = values_of(objective, drives), losses_of(objective, drives)
    assert len(values.unique()) > 10
    assert spearmanr(values, -losses).statistic > 0.95


def test_values_and_losses_are_their_formulas():
    drives = random_drives(5, seed=1)
    cte, clearance = drives.states[1:, :, 1].numpy(), SOLIDS.clearances_m(drives.states[1:]).numpy()
    off = np.abs(cte)
    expected = {
        CrossTrackError(): (off.sum(0), -off.sum(0)),
        Peak(0.2): (off.max(0), -0.08 * (logsumexp(off / 0.08, 0) - np.log(TICKS))),
        TimeOffTrack(0.5): (0.1 * (off > 0.4).sum(0), -0.1 * expit((off - 0.4) / 0.2).sum(0)),
        Collision(0.5): (
            -clearance.min((0, 2)),
            -0.2 * np.log1p(np.exp(-clearance / 0.2).sum((0, 2))),
        ),
    }
    for objective, (value, loss) in expected.items():
        np.testing.assert_allclose(values_of(objective, drives), value, rtol=1e-12)
        np.testing.assert_allclose(losses_of(objective, drives), loss, rtol=1e-12)
    # The smooth maximum lies below the true one, by no more than its docstring says.
    gap = off.max(0) + expected[Peak(0.2)][1]
    assert (gap >= 0.0).all()
    assert (gap <= 0.08 * np.log(TICKS)).all()


def test_the_car_stops_at_the_fence_in_values_and_drives_on_in_losses():
    free = random_drives(20, seed=3)
    fenced = dataclasses.replace(free, fence_m=1.0)
    assert bool((free.states[..., :2].abs() > 1.0).any())
    for objective in (CrossTrackError(), Peak(), TimeOffTrack()):
        assert torch.equal(losses_of(objective, fenced), losses_of(objective, free))
        assert (values_of(objective, fenced) != values_of(objective, free)).any()


@pytest.mark.parametrize("right", [True, False])
def test_run_wide_is_positive_outside_of_a_turn_to_either_side(right):
    free = random_drives(30, seed=4, road=BENT)
    x, y = free.states[1:, :, :2].numpy().transpose(2, 0, 1)
    past = x > 1.0
    expected = np.where(past, np.hypot(x - 1.0, y + 3.0) - 3.0, y)  # the arc's centre is at (1, -3)
    if not right:  # the mirror image, whose outside is on the right
        mirrored = free.states * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        road = Path.from_segments((0.0, 0.0, 0.0), [Line(1.0), Arc(3.0, 1.2)], closed=False)
        free = dataclasses.replace(free, states=mirrored, path=road)
    near = (np.abs(expected) < 0.9).all(0)
    assert near.sum() > 5
    np.testing.assert_allclose(values_of(RunWide(), free)[near], expected.sum(0)[near], rtol=1e-9)
    np.testing.assert_allclose(losses_of(RunWide(), free)[near], -expected.sum(0)[near], rtol=1e-9)
    fenced = dataclasses.replace(free, fence_m=1.0)
    assert torch.equal(losses_of(RunWide(), fenced), losses_of(RunWide(), free))
    assert (values_of(RunWide(), fenced) != values_of(RunWide(), free)).any()


@pytest.mark.parametrize("road", [ROAD, BENT], ids=["straight", "bent"])
def test_a_drift_to_one_side_is_minus_that_to_the_other_and_outside_is_one_of_them(road):
    drives = dataclasses.replace(random_drives(20, seed=5, road=road), fence_m=1.0)
    left, right = values_of(DriftLeft(), drives), values_of(DriftRight(), drives)
    free = dataclasses.replace(drives, fence_m=None)
    signed = road.project(free.states[1:, :, :2].numpy()).cte_m
    np.testing.assert_allclose(losses_of(DriftLeft(), drives), -signed.sum(0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(values_of(DriftLeft(), free), signed.sum(0), rtol=1e-9)
    assert (left > 0.0).any()
    assert (left < 0.0).any()
    assert (left != values_of(DriftLeft(), free)).any()
    assert torch.equal(left, -right)
    assert torch.equal(losses_of(DriftLeft(), drives), -losses_of(DriftRight(), drives))
    if road is BENT:  # it turns to the right
        assert torch.equal(values_of(RunWide(), drives), left)


def test_run_wide_follows_the_turn_of_a_drive_past_the_start_of_a_closed_path():
    loop = Path.rounded_square(4.0, 1.1)
    start = torch.from_numpy(loop.pose_at([loop.length_m - 0.3]))  # its turns are to the left
    states = [start]
    for _ in range(TICKS):
        states.append(Dubins(0.8, 0.1).step(states[-1], torch.zeros(1, dtype=torch.float64)))
    drives = JudgedDrives(torch.stack(states), loop, LIMITS)
    assert float(values_of(RunWide(), drives)) == pytest.approx(float(drives.cte_m.abs().sum()), rel=1e-9)


def test_run_wide_follows_the_first_of_two_turns_that_cancel():
    road = Path.from_segments((0.0, 0.0, 0.0), [Arc(1.0, 1.0), Arc(1.0, -1.2), Line(9.0)], closed=False)
    drives = random_drives(6, seed=8, road=road)
    # Outside of a turn to the left is right.
    assert torch.equal(losses_of(RunWide(), drives), drives.cte_m.sum(0))


def test_run_wide_on_a_straight_road_is_refused():
    with pytest.raises(ObjectiveError, match=r"path with a turn .* turns by 0\.00 rad over the 3\.2 m"):
        values_of(RunWide(), random_drives(2))


def in_the_room(objective: Objective, steps: int = 6):
    solids, starts = Solids((Rectangle(0.5, -1.0, 0.3, 0.2),), SOLIDS.body), {}
    if isinstance(objective, RunWide):
        starts["start_states"] = torch.tensor([[0.8, -1.95, 0.05], [0.9, -2.1, 0.0]], dtype=torch.float64)
    return toy_problem(steps, objective=objective, solids=solids, **starts)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_the_adjoint_of_an_objective_is_back_propagation_with_frozen_poses(name):
    problem = in_the_room(load_objective(name))
    generator = torch.Generator().manual_seed(0)
    theta, direction = torch.randn(
        2, *problem.sensor.theta_shape, dtype=torch.float64, generator=generator
    ).unbind()
    result = adjoint_gradient(problem, theta)
    loss, gradient = backpropagated_gradient(problem, theta, result.rollout)
    assert relative_error(result.gradient, gradient) <= 1e-8
    assert loss == pytest.approx(result.loss, rel=1e-12)
    numeric = finite_difference(problem, theta, result.rollout, direction)
    assert float((result.gradient * direction).sum()) == pytest.approx(numeric, rel=1e-4)


@pytest.mark.parametrize("method", ["random", "gradient", "cem", "guided"])
def test_a_search_keeps_the_best_by_value_whatever_the_total_error_is(method, tmp_path):
    (tmp_path / "left.py").write_text(LEFT)
    objective = load_objective("left.py:Left", tmp_path)
    problem = dataclasses.replace(toy_problem(6, dtype=torch.float32), objective=objective)
    settings = SearchSettings(8, sigma=5.0, population=4, cells=2, probes=1, warm_pairs=2)
    found = METHODS[method].search(problem, settings, SearchRun(seed=1))
    rollout, totals = evaluate(problem, found.theta)
    offsets = problem.path.project(rollout.states[1:, :, :2].numpy()).cte_m
    np.testing.assert_allclose(found.best.values, np.maximum(offsets, 0.0).sum(0), rtol=1e-6)
    assert found.best.value == max(each.value for each in found.history)
    assert found.best.predicted_total_cte_m == pytest.approx(float(totals.protocol_cte_m.mean()), rel=1e-6)
    assert [each.loss_m for each in found.history] == [-each.value for each in found.history]


def test_a_gradient_search_for_the_left_ends_further_left_than_one_for_the_total(tmp_path):
    (tmp_path / "left.py").write_text(LEFT)
    left = load_objective("left.py:Left", tmp_path)
    settings, values = SearchSettings(6), []
    for objective in (CrossTrackError(), left):
        problem = toy_problem(10, dtype=torch.float32, objective=objective)
        theta = METHODS["gradient"].search(problem, settings, SearchRun(seed=2)).theta
        values.append(float(values_of(left, problem.judged(evaluate(problem, theta)[0].states)).mean()))
    assert values[1] > values[0]


def test_a_state_file_of_another_objective_is_refused(tmp_path):
    run = SearchRun(state_path=tmp_path / "state.safetensors")
    METHODS["random"].search(in_the_room(Peak(), 2), SearchSettings(1), run)
    METHODS["random"].search(in_the_room(Peak(), 2), SearchSettings(2), run)
    for other in (CrossTrackError(), Peak(0.2), TimeOffTrack()):
        with pytest.raises(SearchStateError, match="other settings"):
            METHODS["random"].search(in_the_room(other, 2), SearchSettings(3), run)


def test_names_stand_for_objectives_and_wrong_ones_are_one_line(tmp_path):
    assert [type(load_objective(name)).__name__ for name in OBJECTIVES] == list(OBJECTIVES.values())
    file = tmp_path / "mine.py"
    file.write_text(
        LEFT
        + "\nclass Bare(Objective):\n    pass\n\nclass Needy(Objective):\n    def __init__(self, side):\n        pass\n"
        "    def value(self, drives):\n        return drives.cte_m.sum(0)\n\nclass peak(Left):\n    pass\n\nclass Loose:\n    pass\n"
        "\nclass Unitless(Left):\n    unit = 1000\n"
    )
    wrong = {
        "pek": r"expected an objective of cte, run_wide, drift_left, drift_right, peak, time_off_track, collision; got 'pek' .did you mean peak",
        "mine.py:Loose": "expected a class that derives from Objective",
        "mine.py:Bare": "expected a class with a method value",
        "mine.py:Needy": "expected a class that is made without arguments",
        "mine.py:Unitless": "expected a unit such as 'm' or 's', got 1000",
        "mine.py:peak": "expected a name that no built-in objective has",
        "none.py:Left": "expected a Python file",
    }
    for name, message in wrong.items():
        with pytest.raises(PluginError, match=message):
            load_objective(name, tmp_path)


def test_a_key_follows_the_code_and_not_the_folder(tmp_path):
    files = [tmp_path / folder / "left.py" for folder in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        file.write_text(LEFT)
    keys = [objective_key(f"{file}:Left") for file in files]
    assert keys[0] == keys[1] == ["Left", keys[0][1]]
    assert name_in_results(f"{files[0]}:Left") == "Left"
    files[1].write_text(LEFT.replace("min=0.0", "min=0.1"))
    assert objective_key(f"{files[1]}:Left") != keys[0]
    assert objective_key("peak") == "peak"


class MovesStates(Objective):
    def value(self, drives):
        place = drives.states[1:, :, :2]
        place -= torch.tensor([3.0, 0.0], dtype=place.dtype)
        return -place.norm(dim=-1).sum(0)


class MovesErrors(Objective):
    def value(self, drives):
        errors = drives.cte_m
        errors -= 0.02
        return errors.clamp_(min=0.0).sum(0)


class MovesThroughNumpy(Objective):
    def value(self, drives):
        drives.states.detach().numpy()[1:, :, 0] -= 1.0
        return drives.cte_m.abs().sum(0)


@pytest.mark.parametrize(
    ("objective", "name"),
    [(MovesStates(), "states"), (MovesErrors(), "cte_m"), (MovesThroughNumpy(), "states")],
)
@pytest.mark.parametrize("judged", [values_of, losses_of])
def test_an_objective_that_changes_the_drives_in_place_is_refused(objective, name, judged):
    """The changed numbers would be the car's drive: a harmless texture had been reported 5 m off the track."""
    with pytest.raises(
        ObjectiveError, match=rf"{type(objective).__name__} to leave drives\.{name} as it is, .* x = x - y"
    ):
        judged(objective, random_drives(3))


class OfAll(Objective):
    def value(self, drives):
        return drives.cte_m.abs().sum().expand(drives.cte_m.shape[1])


class AboutTheMean(Objective):
    def value(self, drives):
        return drives.cte_m.abs().sum(0)

    def loss(self, drives):
        errors = drives.cte_m.abs()
        return (errors.mean() - errors).sum(0)


class DrawsLots(Objective):
    def value(self, drives):
        return drives.cte_m.sum(0) + torch.rand(1)


class CountsItsCalls(Objective):
    calls = 0

    def value(self, drives):
        self.calls += 1
        return drives.cte_m.sum(0) + self.calls


@pytest.mark.parametrize("objective", [OfAll(), AboutTheMean(), DrawsLots(), CountsItsCalls()])
def test_an_objective_that_does_not_judge_each_drive_alone_is_refused(objective):
    """A search keeps the theta of the highest value: of lots and counts that is any, and a batch of seeds would share one."""
    with pytest.raises(
        ObjectiveError, match=r"to judge each drive by that drive alone, and the same each time"
    ):
        losses_of(objective, random_drives(3))


def test_an_objective_of_one_drive_that_draws_lots_is_refused():
    with pytest.raises(ObjectiveError, match=r"for the first of 1 and .* for it alone"):
        values_of(DrawsLots(), random_drives(1))


def test_a_loss_that_rises_with_its_value_is_refused():
    """A gradient would keep the car on its path, and the first texture would be the result."""

    class Forgot(Objective):
        def value(self, drives):
            return drives.cte_m.abs().sum(0)

        def loss(self, drives):
            return drives.cte_m.abs().sum(0)

    class Relaxed(Forgot):
        def loss(self, drives):
            return -torch.tanh(drives.cte_m.abs()).sum(0)

    with pytest.raises(
        ObjectiveError,
        match=r"loss of Forgot that falls as its value rises, .*cosine of their slopes \+1\.00",
    ):
        loss_slopes(Forgot(), random_drives(3))
    assert loss_slopes(Relaxed(), random_drives(3))[0] < 0.0


def test_what_an_objective_keeps_has_no_address_in_a_state(tmp_path):
    class Keeps(CountsItsCalls):
        def __init__(self):
            self.lock = object()

        def value(self, drives):
            return drives.cte_m.sum(0)

    run = SearchRun(state_path=tmp_path / "state.safetensors")
    METHODS["random"].search(in_the_room(Keeps(), 2), SearchSettings(1), run)
    resumed = METHODS["random"].search(in_the_room(Keeps(), 2), SearchSettings(2), run)
    assert len(resumed.history) == 2


def test_what_breaks_the_contract_is_one_line():
    class Constant(Objective):
        def value(self, drives):
            return torch.ones(drives.states.shape[1])

    class Counts(Objective):
        def value(self, drives):
            return (drives.cte_m.abs() > 0.1).sum(0)

    class Root(Objective):
        def value(self, drives):
            return (-1.0 - drives.cte_m.abs().sum(0)).sqrt()

    class Any(Objective):
        def value(self, drives):
            return (drives.cte_m.abs() > 0.1).any(0)

    class Complex(Objective):
        def value(self, drives):
            return torch.complex(drives.cte_m.sum(0), drives.cte_m.sum(0))

    class Exits(Objective):
        def value(self, drives):
            raise SystemExit

    class Whole(Objective):
        def value(self, drives):
            return drives.cte_m.abs().sum()

    drives = random_drives(3)
    assert values_of(Constant(), drives).tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(ObjectiveError, match=r"loss of Constant that is differentiable in drives.states"):
        loss_slopes(Constant(), drives)
    with pytest.raises(ObjectiveError, match=r"loss of Counts that is differentiable"):
        loss_slopes(Counts(), drives)
    assert losses_of(Any(), drives).tolist() == [-float(each) for each in values_of(Any(), drives)]
    with pytest.raises(PluginError, match=r"it has called sys\.exit"):
        values_of(Exits(), drives)
    for judged in (values_of, losses_of):
        with pytest.raises(ObjectiveError, match=r"value of Complex to return a tensor .*complex"):
            judged(Complex(), drives)
        with pytest.raises(
            ObjectiveError, match=r"finite value of Root for each drive, got \[nan, nan, nan\]"
        ):
            judged(Root(), drives)
    with pytest.raises(
        ObjectiveError, match=r"value of Whole to return a tensor \[3\].*got torch.float64 of shape \[\]"
    ):
        values_of(Whole(), drives)
    with pytest.raises(ObjectiveError, match=r"expected a place with solids for the objective Collision"):
        toy_problem(2, objective=Collision())
    with pytest.raises(ObjectiveError, match="got one without solids"):
        _ = dataclasses.replace(drives, solids=None).clearances_m
