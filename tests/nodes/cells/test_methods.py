"""A method that a user brings, in the worker processes of an experiment: named, found, run again when its code changes, alone when it fails."""

import json

import pytest
import torch

from advnerf_core.attack.methods import MethodError
from advnerf_core.report.result_page import text_table
from nodes.experiment.plan.cell import select
from nodes.experiment.run.plan import statuses
from nodes.experiment.run.published import table_of
from nodes.experiment.run.run import Options, run_cells
from nodes.runtime.errors import ConfigError
from tests.support.attack_toy import toy_problem
from tests.support.strangers import install_method, spiral_code, spiral_theta, write_spiral


@pytest.fixture
def searching(here):
    write_spiral(here.folder)
    here.write(seed=[1], method=["none", "spiral.py:Spiral", "spiral"])
    return here


def run(bench, **options):
    loaded, said = bench.load(), []
    return run_cells(loaded, loaded.cells, Options(**options), said.append), said


def states(bench):
    loaded = bench.load()
    return {each.cell.name: each.state for each in statuses(loaded, loaded.cells)}


def test_methods_of_a_file_and_of_a_package_run_in_worker_processes_and_appear_in_the_table(
    searching, monkeypatch, tmp_path
):
    install_method(searching.folder, monkeypatch, spiral_code())
    loaded = searching.load()
    names = [f"straight_hardened_{method}" for method in ("none_0", "Spiral_1", "spiral_1")]
    assert [cell.name for cell in loaded.cells] == names
    assert [cell.name for cell in select(loaded.cells, "method=Spiral")] == [names[1]]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)  # references are relative to the experiment file
    ended, _ = run(searching, jobs=2)
    assert {end.how for end in ended} == {"done"}
    (begun,) = [line for line in searching.calls if line.startswith("begin straight_hardened_Spiral_1 ")]
    assert begun.split()[2] == f"{searching.folder / 'spiral.py'}:Spiral"
    result = json.loads((searching.cells / f"{names[1]}.json").read_text())
    assert result["method"] == "Spiral"
    shape = toy_problem(2).sensor.theta_shape
    thetas = [spiral_theta(shape, number, seed=1).flatten() for number in range(3)]
    found = torch.tensor(result["extra"]["theta"])
    assert min(float((found - theta).abs().max()) for theta in thetas) < 1e-5
    table = text_table(table_of(loaded, statuses(loaded, loaded.cells)))
    assert [row[2] for row in table.rows if row[2]] == ["plain object", "Spiral", "spiral"]


def test_its_cells_run_again_when_its_code_changes_and_no_others(searching):
    searching.write(seed=[1], method=["none", "spiral.py:Spiral"])
    run(searching, here=True)
    (searching.folder / "spiral.py").write_text(
        spiral_code().replace("growth: float = 0.2", "growth: float = 0.4")
    )
    assert [name for name, state in states(searching).items() if state != "done"] == [
        "straight_hardened_Spiral_1"
    ]
    ended, _ = run(searching, here=True)
    assert [(end.name, end.how) for end in ended] == [("straight_hardened_Spiral_1", "done")]


def test_a_broken_method_fails_alone_and_in_one_line(searching):
    searching.write(seed=[1], method=["none", "spiral.py:Spiral"])
    (searching.folder / "spiral.py").write_text("turns = 1 / 0\n")
    ended, _ = run(searching, here=True)
    how = {end.name: (end.how, end.text) for end in ended}
    state, text = how.pop("straight_hardened_Spiral_1")
    assert state == "failed"
    assert "cannot be loaded: ZeroDivisionError: division by zero" in text
    assert "\n" not in text
    assert {state for state, _ in how.values()} == {"done"}


@pytest.mark.parametrize(
    ("methods", "says"),
    [
        (
            ["none", "spirel.py:Spiral"],
            r"toy.experiment.yaml:\d+: over.method.1: attack method spirel.py:Spiral: expected a Python file at",
        ),
        (
            ["none", "spiral"],
            r": over.method.1: expected an attack method of random, .*; got 'spiral'; one of your own is file.py:Name",
        ),
        (
            ["spiral.py:Spiral", "other.py:Spiral"],
            "expected methods of different names, .* got Spiral, Spiral; rename one in its file",
        ),
        (["spiral.py:cem"], "expected a name that no other condition has, got cem"),
    ],
)
def test_what_cannot_be_is_told_with_its_line(searching, methods, says):
    (searching.folder / "other.py").write_text(spiral_code())
    searching.write(seed=[0], method=methods)
    with pytest.raises(ConfigError, match=says):
        searching.load()


def test_an_option_that_no_method_of_a_variant_has_ends_a_run_before_its_first_cell(here):
    write_spiral(here.folder)
    wrong = {"over.path": ["loop"], "run_folder": "other", "attack.options.turn": 1}
    here.write(variants={"wrong": wrong}, method=["none", "random", "spiral.py:Spiral"])
    with pytest.raises(
        MethodError, match=r"attack.options.turn: .*; random has none, Spiral has turns, growth"
    ):
        run(here, jobs=1)
    assert here.calls == []
