"""An experiment maximises the objective that its file names."""

import json
import re
import shutil

import pytest

from advnerf_core.attack.artifact import load_attack
from advnerf_core.report.data import Maximised
from nodes.experiment.pages.gather import _curves, _maximised
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import run_cell
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.steps.attack import ATTACK
from nodes.experiment.steps.keys import NoSuchCellError, cell_settings, registered_settings, settings_hash
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from tests.support.stage_versions import ROOT, TINY

LEFT = """
from advnerf_core.attack.objective import Objective

class Left(Objective):
    def value(self, drives):
        return drives.cte_m.clamp(min=0.0).sum(0)
"""
FILE, RANDOM, NONE = (
    ROOT / "launch" / "room.experiment.yaml",
    Cell("track", "hardened", "random", 0),
    Cell("track", "hardened", "none", 0),
)


def experiment_of(folder, objective):
    return load_experiment(FILE, "demo", [*TINY, f"attack.objective={objective}"], folder)


def test_keys_follow_the_objective_where_something_is_searched(tmp_path):
    keys = {}
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.py").write_text(LEFT)
    own = {name: f"{tmp_path / name / 'mine.py'}:Left" for name in ("a", "b")}
    plain = load_experiment(FILE, "demo", TINY, tmp_path / "run")
    for name, objective in {"cte": "cte", "peak": "peak", **own}.items():
        found = experiment_of(tmp_path / "run", objective)
        keys[name] = registered_settings(found).keyed["objective"]
        assert cell_settings(found, NONE) == cell_settings(plain, NONE)
        same = settings_hash(found, RANDOM) == settings_hash(plain, RANDOM)
        assert same == (name == "cte")
    assert keys["cte"] == "cte"
    assert keys["peak"] == "peak"
    assert keys["a"] == keys["b"]
    assert keys["a"][0] == "Left"
    assert str(tmp_path) not in json.dumps(keys)


def test_a_cell_is_searched_for_the_objective_of_a_file_without_a_change_of_the_project(tiny_room, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(tiny_room[0], folder, ignore=shutil.ignore_patterns("cells"))
    (tmp_path / "mine.py").write_text(LEFT)
    experiment = experiment_of(folder, f"{tmp_path / 'mine.py'}:Left")
    found = run_cell(experiment, RANDOM, experiment.cell_folder(RANDOM), lambda part, text="": None)
    attack = load_attack(experiment.cell_folder(RANDOM) / ATTACK)
    kept = json.loads((experiment.cell_folder(RANDOM) / "surrogate.json").read_text())
    entry = attack.extra["objective"]
    assert entry == {**entry, "name": "Left", "unit": "m", "value": max(kept["curve_value"])}
    assert found["extra"]["objective"] == kept["objective"] == entry
    (curve,) = _curves(experiment, RANDOM)
    assert (curve.values.tolist(), curve.plain) == (kept["curve_value"], entry["clean_value"])
    assert _maximised(experiment) == Maximised("Left", "m")
    assert found["surrogate"]["total_cte_m"][0] > 0.0


def test_a_collision_needs_a_world_with_solids(tiny_room, tmp_path):
    experiment = experiment_of(tiny_room[0], "collision")
    assert experiment.solids is not None
    assert len(experiment.solids.rectangles) > 20
    warehouse = ROOT / "examples" / "warehouse.experiment.yaml"
    with pytest.raises(ConfigError, match=r"attack.objective: expected an objective that needs no solids"):
        load_experiment(warehouse, "demo", ["attack.objective=collision"], tmp_path / "other")


BROKEN = {
    "no class of ours": (
        "class Left:\n    pass\n",
        r"expected a class that derives from Objective .*, got the class Left",
    ),
    "an error": (
        "1 / 0\n",
        r"mine\.py cannot be loaded: ZeroDivisionError: division by zero \(.*mine\.py:1\)",
    ),
}


@pytest.mark.parametrize("what", ["attack.objective", "over.method"])
@pytest.mark.parametrize("fault", BROKEN)
def test_code_that_cannot_be_searched_with_is_refused_before_any_stage(tmp_path, what, fault):
    (tmp_path / "mine.py").write_text(BROKEN[fault][0])
    reference = f"{tmp_path / 'mine.py'}:Left"
    change = f"{what}={reference}" if what == "attack.objective" else f"over.method=[none,'{reference}']"
    experiment = load_experiment(FILE, "demo", [*TINY, change], tmp_path / "run")
    with pytest.raises(NoSuchCellError, match=rf"room\.experiment\.yaml: .*{reference}") as error:
        run_experiment(experiment)
    if what == "attack.objective":
        assert re.search(BROKEN[fault][1], str(error.value)), error.value
    assert not list((tmp_path / "run").glob("*/stage.json"))
