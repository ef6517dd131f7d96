"""Cells of live experiments: what they depend on, what they may spend, and where their drives lie."""

from pathlib import Path

import pytest

from advnerf_core.attack.methods import METHODS, MethodError, load_method
from advnerf_core.plugins import name_in_results
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import runs_alone
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.steps.attack import search_settings
from nodes.experiment.steps.keys import cell_settings, clean_folder, require_searchable
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from tests.support.strangers import write_spiral

LAUNCH = Path(__file__).parents[3] / "launch"


def room(folder, *overrides, file="room"):
    return load_experiment(LAUNCH / f"{file}.experiment.yaml", "full", overrides, folder)


def test_methods_and_seeds_of_one_victim_share_the_live_drive_without_attack(tmp_path):
    experiment = room(tmp_path / "run", file="monitor")
    gradient, none, other = (
        Cell("track", "hardened", method, seed) for method, seed in (("gradient", 1), ("none", 1), ("cem", 2))
    )
    folders = [clean_folder(experiment, cell, tmp_path / cell.name) for cell in (gradient, none, other)]
    assert folders[0] == folders[1] == folders[2]
    # Of other settings it is another drive.
    slower = room(tmp_path / "run", "world.car.speed_mps=0.6", file="monitor")
    assert clean_folder(slower, none, tmp_path / none.name) != folders[0]


def test_live_nodes_have_the_machine_for_themselves(tmp_path):
    assert runs_alone(room(tmp_path))
    assert not runs_alone(room(tmp_path, "deploy.through=world"))


def test_what_changes_no_result_is_no_part_of_what_a_cell_depends_on(tmp_path):
    def inputs(*overrides):
        return cell_settings(room(tmp_path, *overrides), Cell("track", "hardened", "gradient", 0))

    for free in ("attack.cache_mib=64", "over.seed=[4]", "deploy.laps=0", "deploy.ready_timeout_s=90"):
        assert inputs(free) == inputs(), free
    none = Cell("track", "hardened", "none", 0)
    assert cell_settings(room(tmp_path, "attack.evaluations=7"), none) == cell_settings(room(tmp_path), none)
    assert inputs("attack.evaluations=7") != inputs()
    for counts in ("attack.starts=2", "deploy.through=world", "world.car.speed_mps=0.6"):
        assert inputs(counts) != inputs(), counts


def test_all_methods_may_evaluate_equally_often_and_those_without_a_gradient_search_a_coarse_face(tmp_path):
    changes = ["attack.evaluations=7", "attack.learning_rate=0.3", "attack.random_sigma=2", "space.cells=4"]
    experiment = room(tmp_path, *changes)
    settings = {name: search_settings(experiment, METHODS[name]) for name in METHODS}
    assert {each.evaluations for each in settings.values()} == {7}
    assert {(each.gradient_rate, each.random_sigma) for each in settings.values()} == {(0.3, 2.0)}
    assert {(each.learning_rate, each.sigma, each.population, each.cells) for each in settings.values()} == {
        (None, None, 10, 4)
    }


def test_the_control_without_objects_is_no_unknown_method(tmp_path):
    experiment = room(tmp_path, "over.method=[none,empty,random]", file="junction")
    assert "empty" in [cell.method for cell in experiment.cells]
    require_searchable(experiment, experiment.cells)


def test_a_method_that_a_user_brings_names_its_cells(tmp_path):
    write_spiral(tmp_path)
    reference = f"{tmp_path / 'spiral.py'}:Spiral"
    cell = Cell.of("track", "hardened", reference, 1)
    assert cell.name == f"track_hardened_{name_in_results(reference)}_1"
    assert load_method(cell.reference) is load_method(reference)


def test_each_method_takes_its_own_of_the_options_of_all(tmp_path):
    reference = f"{write_spiral(tmp_path)}:Spiral"
    asked = [f"over.method=[none,random,'{reference}',guided]", "attack.options.growth=0.4"]
    experiment = room(tmp_path / "run", *asked, "attack.options.student=resnet")
    found = {
        name: search_settings(experiment, load_method(name)).options for name in experiment.config.methods
    }
    assert found["random"] is None
    assert (found[reference].growth, found[reference].turns) == (0.4, 0.1)
    assert found["guided"].student == "resnet"
    wrong = room(tmp_path / "run", *asked, "attack.options.turn=1")
    with pytest.raises(
        MethodError,
        match=r"attack.options.turn: .*did you mean turns\?\); random has none, Spiral has turns, growth, guided has student",
    ):
        run_experiment(wrong)
    assert not list((tmp_path / "run").glob("*/stage.json"))
    with pytest.raises(
        ConfigError,
        match=r"options.growth: expected an option of a listed method of student.*; random has none, guided has",
    ):
        room(tmp_path / "run", "over.method=[random,guided]", "attack.options.growth=0.4")
