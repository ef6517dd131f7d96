"""The junction's experiment in ticks of a hundredth of a second: same ground in the same time, ten times the sum, the right gradient."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import DriveMetrics, drive_metrics
from advnerf_core.driving.rollout import drive
from advnerf_core.geometry import Array
from advnerf_core.report.clips import read_clip
from hardware.worlds.junction.config import DubinsConfig
from hardware.worlds.world import World
from nodes.experiment.engine.run_folder import SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import SelfDriving
from nodes.experiment.show.objects import placed_objects, surrogate_of
from nodes.experiment.show.spaces import colour_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem, surrogate_part
from nodes.experiment.steps.deploy import DRIVES, cell_data
from nodes.experiment.steps.films import film_cell, filmed
from nodes.experiment.steps.run import load_experiment

LAUNCH = Path(__file__).parents[3] / "launch" / "junction.experiment.yaml"
SECONDS, TICKS_S = 2.0, (0.1, 0.01)
ASKEW_RAD = 0.05


class Holds:
    """A policy that always turns at one rate [rad/s]."""

    stateless = True

    def __init__(self, turn_rate_radps: float) -> None:
        self.turn_rate_radps = turn_rate_radps

    def __call__(self, images: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
        return torch.full((len(images),), self.turn_rate_radps, dtype=torch.float64)


def in_ticks_of(dt_s: float, folder: Path) -> Experiment:
    """The experiment over the same time, as docs/intersection.md says to ask for it."""
    ticks = round(SECONDS / dt_s)
    changes = [f"dt_s={dt_s}", f"horizon={ticks}", f"policy.drive_steps={ticks}"]
    return load_experiment(LAUNCH, "full", changes, folder)


@pytest.fixture(scope="module")
def junction(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with in_ticks_of(0.1, tmp_path_factory.mktemp("junction")).open_world() as scene:
        yield scene


def driven(experiment: Experiment, car: Dubins | SelfDriving, turn_rate_radps: float, start: Array) -> Array:
    """States ``[T + 1, 3]``; nobody looks."""
    if isinstance(car, SelfDriving):
        car.start(start)
    blank = torch.zeros(1, 3, 66, 200)
    first = torch.from_numpy(start)[None]
    states = drive(Holds(turn_rate_radps), lambda _: blank, car, first, experiment.config.horizon).states
    return states[:, 0].numpy()


def where(
    start: Array, turn_rate_radps: float, lag_s: float, gain: float, after_s: float
) -> tuple[float, float]:
    """Speed times time along the heading: the turn rate's lag in closed form, the way by quadrature."""

    def heading_rad(t_s: float) -> float:
        lost_s = lag_s * -np.expm1(-t_s / lag_s) if lag_s else 0.0
        return float(start[2] + gain * turn_rate_radps * (t_s - lost_s))

    x_m = start[0] + quad(lambda t_s: 6.0 * np.cos(heading_rad(t_s)), 0.0, after_s)[0]
    y_m = start[1] + quad(lambda t_s: 6.0 * np.sin(heading_rad(t_s)), 0.0, after_s)[0]
    return x_m, y_m


@pytest.mark.parametrize("turn_rate_radps", [0.0, 0.15])
def test_both_cars_are_where_speed_and_time_say(
    junction: World, tmp_path: Path, turn_rate_radps: float
) -> None:
    for dt_s in TICKS_S:
        experiment = in_ticks_of(dt_s, tmp_path)
        start, flaws = np.array(experiment.references["straight"].start_pose), DubinsConfig()
        deployed = SelfDriving(junction, flaws.speed_mps, experiment.limits.dt_s)
        cars: list[tuple[Dubins | SelfDriving, float, float]] = [
            (experiment.dynamics, 0.0, 1.0),
            (deployed, flaws.turn_rate_lag_s, flaws.turn_rate_gain),
        ]
        for car, lag_s, gain in cars:
            states = driven(experiment, car, turn_rate_radps, start)
            assert len(states) == round(SECONDS / dt_s) + 1
            for share in (0.25, 0.5, 1.0):
                expected = where(start, turn_rate_radps, lag_s, gain, share * SECONDS)
                assert states[round(share * SECONDS / dt_s), :2] == pytest.approx(expected, abs=1e-4)
            way_m = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1).sum()
            assert way_m == pytest.approx(6.0 * SECONDS, rel=1e-4)


def test_total_cte_is_the_sum_over_the_ticks_that_there_are(junction: World, tmp_path: Path) -> None:
    found: dict[float, DriveMetrics] = {}
    for dt_s in TICKS_S:
        experiment = in_ticks_of(dt_s, tmp_path)
        start = np.add(experiment.references["straight"].start_pose, [0.0, 0.0, ASKEW_RAD])
        car = SelfDriving(junction, experiment.car.speed_mps, dt_s)
        states = driven(experiment, car, 0.0, start)
        found[dt_s] = drive_metrics(experiment.paths["straight"], states, experiment.limits, car.blocked_tick)
        # A straight line away from a straight line: |CTE| = v t sin(angle) at t = dt, 2 dt, ..., T dt.
        ticks = round(SECONDS / dt_s)
        assert found[dt_s].total_cte_m == pytest.approx(
            6.0 * np.sin(ASKEW_RAD) * dt_s * ticks * (ticks + 1) / 2
        )
        assert found[dt_s].mean_cte_m == pytest.approx(found[dt_s].total_cte_m / ticks)
        assert found[dt_s].max_cte_m == pytest.approx(6.0 * SECONDS * np.sin(ASKEW_RAD))
    coarse, fine = (found[dt_s] for dt_s in TICKS_S)
    assert fine.total_cte_m / coarse.total_cte_m == pytest.approx(10.0, rel=0.05)
    assert fine.mean_cte_m == pytest.approx(coarse.mean_cte_m, rel=0.05)


def finer(trained: Experiment, horizon: int, folder: Path) -> Experiment:
    """What is trained, attacked in ticks of 0.01 s in a folder of its own."""
    shutil.copytree(trained.folder, folder)
    config = trained.config.model_copy(update={"dt_s": 0.01, "horizon": horizon})
    return replace(trained, config=config, folder=folder)


def test_the_gradient_is_what_a_turn_of_a_hundredth_of_a_second_is_worth(
    trained: Experiment, tmp_path: Path
) -> None:
    experiment = finer(trained, 8, tmp_path / "run")
    space = colour_space(
        experiment, surrogate_of(experiment, placed_objects(experiment)).in_type(torch.float64)
    )
    surrogate = space.surrogate
    loaded = load_victim(experiment, HARDENED)
    loaded.policy.double()
    x_m, y_m, yaw_rad = experiment.references["straight"].start_pose
    aside = torch.tensor([[x_m, y_m + 0.5, yaw_rad]], dtype=torch.float64)  # where |CTE| has no kink
    plain = attack_problem(experiment, space, loaded, "straight", 0)
    assert plain.goals is not None
    problem = replace(plain, start_states=aside, goals=plain.goals.double())
    theta = surrogate.initial_theta(torch.Generator().manual_seed(0))
    found = adjoint_gradient(problem, theta)
    along = torch.randn(theta.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    states, step = found.rollout.states, 1e-3
    turned = []
    for state in states[:-1]:
        more, less = (
            problem.policy(surrogate.sense(state, theta + sign * step * along).images, problem.goals)
            for sign in (1, -1)
        )
        turned.append(float((more - less)[0]) / (2.0 * step))
    # Turning at a rate u for one tick turns what is driven afterwards by u dt: v dt of way per tick, half of it in the tick itself.
    ticks, dt_s = len(turned), 0.01
    worth = [
        sum(6.0 * dt_s * dt_s * (after - tick - 0.5) for after in range(tick + 1, ticks + 1))
        for tick in range(ticks)
    ]
    heading = float(torch.cos(states[:, 0, 2]).mean())
    assert states[-1, 0, 1] > y_m  # on the left throughout, so that what turns left adds to |CTE|
    expected = -heading * float(np.dot(turned, worth))
    assert expected != 0.0
    assert float((found.gradient * along).sum()) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_search_drive_and_film_in_finer_ticks(trained: Experiment, wall: Any, tmp_path: Path) -> None:
    experiment, cell = finer(trained, 10, tmp_path / "run"), Cell("straight", HARDENED, "gradient", 0)
    space, folder, clean = colour_space(experiment), tmp_path / "cell", tmp_path / "clean"
    for each, at in ((cell.clean, clean), (cell, folder)):
        found = surrogate_part(experiment, space, each, at, lambda fraction, text="": None)
    assert len(found["curve_total_cte_m"]) == experiment.config.attack.evaluations
    result = cell_data(experiment, space, wall, cell, folder, clean, print)
    assert result["extra"]["horizon"] == 10
    for name in (SEARCHED, DRIVES):
        (states,) = np.array(json.loads((folder / name).read_text())["states"])
        way_m = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1).sum()
        assert way_m == pytest.approx(6.0 * 10 * 0.01, rel=1e-3)
    # A film shows every tenth tick: the start and the end.
    assert len(read_clip(film_cell(experiment, wall, space, cell, folder, folder))) == 2


@pytest.mark.parametrize(
    ("dt_s", "every", "rate_hz"), [(0.1, 1, 10.0), (0.01, 10, 10.0), (0.05, 2, 10.0), (0.2, 1, 5.0)]
)
def test_films_run_in_real_time(dt_s: float, every: int, rate_hz: float) -> None:
    assert filmed(dt_s) == (every, pytest.approx(rate_hz))
