"""Pictures that a prediction looks at, from the simulated junction itself, untrained scene and policy."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import run_cell, search_cell
from nodes.experiment.run.gate import lacks, predict_cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import DressedScene
from nodes.experiment.show.drives import deployed_drives
from nodes.experiment.show.objects import placed_objects
from nodes.experiment.steps import fidelity
from nodes.experiment.steps.keys import clean_folder

WHICH = Cell("right", "hardened", "random", 0)


def _quiet(fraction: float, text: str = "") -> None:
    """Report of a test."""


@pytest.fixture(scope="module")
def searched(trained: Experiment, tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, Path]:
    """A cell's folder with a finished search, deployed without attack alone; its own copy of the experiment."""
    folder = tmp_path_factory.mktemp("fidelity")
    experiment = replace(trained, folder=shutil.copytree(trained.folder, folder / "run"))
    cell = folder / "cell"
    cell.mkdir()
    (folder / "none").mkdir()
    assert lacks(experiment, WHICH, cell) == "its search"
    search_cell(experiment, WHICH, cell, _quiet)
    assert "method=none" in lacks(experiment, WHICH, cell)
    run_cell(experiment, WHICH.clean, folder / "none", _quiet)
    assert lacks(experiment, WHICH, cell) == ""
    return experiment, cell


def test_real_pictures_are_what_the_policy_saw_on_the_clean_drive(searched: tuple[Experiment, Path]) -> None:
    experiment, cell = searched
    clean = fidelity.driven(experiment, WHICH, clean_folder(experiment, WHICH, cell))
    policy, goal = fidelity.policy_of(experiment, WHICH)
    assert goal == experiment.goal("right")
    with experiment.open_world() as scene:
        dressed = DressedScene(scene, experiment.view, placed_objects(experiment))
        start = experiment.measured_starts("right")[:1]
        (drive,) = deployed_drives(experiment, dressed, policy, "right", start, dressed.plain_theta())
        scene.reset(*drive.states[1])
        rgb, _ = scene.observe(depth=False)
    assert clean.real.shape == clean.learned.shape == (experiment.config.horizon, 66, 200, 3)
    # Where no object is, a picture is the bare scene's: at least its upper rows, which are sky and houses.
    assert np.array_equal(clean.real[1][:8], experiment.view.image(rgb)[:8])


def test_an_attack_changes_only_where_objects_are(searched: tuple[Experiment, Path]) -> None:
    experiment, cell = searched
    clean = fidelity.driven(experiment, WHICH, clean_folder(experiment, WHICH, cell))
    attacked = fidelity.attacked(experiment, WHICH, cell, clean_folder(experiment, WHICH, cell))
    changed = [(a != b).any(-1) for a, b in ((clean.real, attacked.real), (clean.learned, attacked.learned))]
    for each in changed:
        assert 0.0 < each.mean() < 0.3
    both = changed[0] & changed[1]
    assert both.sum() > 0.3 * changed[0].sum()  # rough untrained objects, yet in the same places


def test_a_prediction_needs_no_drive_with_the_attack(searched: tuple[Experiment, Path]) -> None:
    experiment, cell = searched
    before = {path.name for path in cell.iterdir()}
    found, clean = predict_cell(experiment, WHICH, cell, draws=9)
    assert found.attacked_m != found.none_m
    assert len(clean.agreement.real) == experiment.config.horizon
    assert predict_cell(experiment, WHICH, cell, 9, clean)[0] == found
    assert {path.name for path in cell.iterdir()} == before
