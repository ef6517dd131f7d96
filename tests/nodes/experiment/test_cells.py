"""Cells of the room in a campaign: where their parts lie, and what a live drive says of its end."""

from pathlib import Path

import pytest

from advnerf_core.attack.methods import METHODS, load_method, method_name
from nodes.experiment.attack import search_settings
from nodes.experiment.cells import _cell, blocked_tick, cell_inputs
from nodes.experiment.run import load_experiment
from tests.support.strangers import write_spiral

LAUNCH = Path(__file__).parents[3] / "launch"


def driven(states, stopped_early=""):
    return {"outcome": {"stopped_early": stopped_early}, "states": states}


@pytest.mark.parametrize("method", ["none", "random", "gradient"])
def test_search_and_live_drive_of_a_cell_leave_different_files(tmp_path, method):
    experiment = load_experiment(LAUNCH / "monitor.experiment.yaml", "full", [], tmp_path / "run")
    cell = _cell(experiment, "monitor", "hardened", method, 1, tmp_path / "cell")
    name = f"hardened_{method}_1.json"
    assert cell.live(method).name + ".json" == name
    assert cell.searched_in(method) / name != cell.driven_in(method) / name


def test_memory_for_the_cache_is_no_part_of_what_a_cell_depends_on(tmp_path):
    def inputs(*overrides):
        experiment = load_experiment(LAUNCH / "room.experiment.yaml", "full", overrides, tmp_path)
        return cell_inputs(experiment, "", "hardened", "gradient", 0)

    assert inputs("attack.cache_mib=64") == inputs()
    assert inputs("attack.starts=2") != inputs()


def test_a_car_that_runs_into_something_stands_from_then_on():
    free = [[0.08 * tick, 0.0, 0.0] for tick in range(20)]
    against_it = free + [
        [1.52 + 0.001 * (tick % 2), 0.0, 0.0] for tick in range(10)
    ]  # motion capture's noise
    assert blocked_tick(driven(free)) is None
    assert blocked_tick(driven(against_it)) == 19
    assert blocked_tick(driven(against_it, "outside of the fence")) is None
    assert blocked_tick(driven(against_it, "stalled: the car does not move")) == 19


def test_a_method_gets_its_own_part_of_the_budget(tmp_path):
    """The gradient's iterations and rate are not those of methods without a gradient, nor the spread of random textures theirs."""
    changes = [
        "attack.iterations=7",
        "attack.random_evaluations=5",
        "attack.learning_rate=0.3",
        "attack.random_sigma=2",
    ]
    experiment = load_experiment(LAUNCH / "room.experiment.yaml", "full", changes, tmp_path)
    settings = {name: search_settings(experiment, METHODS[name]) for name in METHODS}
    assert {name: each.evaluations for name, each in settings.items() if each.evaluations != 5} == {
        "gradient": 7
    }
    assert {(each.gradient_rate, each.random_sigma) for each in settings.values()} == {(0.3, 2.0)}
    assert {(each.learning_rate, each.sigma, each.population, each.cells) for each in settings.values()} == {
        (None, None, 10, 8)
    }


def test_a_method_that_a_user_brings_depends_on_all_that_it_may_spend(tmp_path):
    write_spiral(tmp_path)

    def inputs(method, *overrides):
        experiment = load_experiment(LAUNCH / "room.experiment.yaml", "full", overrides, tmp_path / "run")
        return cell_inputs(experiment, "", "hardened", method, 0)

    for method, spent in ((f"{tmp_path / 'spiral.py'}:Spiral", True), ("evolution", True), ("cem", False)):
        assert (inputs(method, "attack.random_sigma=2") != inputs(method)) == spent
        experiment = load_experiment(LAUNCH / "room.experiment.yaml", "full", [], tmp_path / "run")
        cell = _cell(experiment, "", "hardened", method, 1, tmp_path)
        assert cell.search.name == f"hardened_{method_name(method)}_1"
        assert cell.live(cell.method).name == cell.search.name
        assert load_method(cell.search.reference) is load_method(method)
