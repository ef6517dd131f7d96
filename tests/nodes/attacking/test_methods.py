"""A method that a user brings runs a request, and a broken one is one line."""

import json

import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.methods import MethodError
from advnerf_core.attack.search.search import SearchStateError
from advnerf_core.errors import AdvnerfError
from nodes.experiment.node.prepare import prepare, request_text
from nodes.experiment.node.request import parse_request
from nodes.experiment.node.search import run_attack
from nodes.experiment.node.worker import work
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay
from tests.support.commands import advnerf
from tests.support.strangers import install_method, spiral_code, spiral_theta, write_spiral
from tests.support.tiny_request import StoppedError, loaded, stop_at_one, tiny_request

FORGETFUL = """
import torch
from advnerf_core.attack.methods import Method, SearchRun
from advnerf_core.attack.search.search import SearchState, evaluate_theta

def search(problem, settings, run):
    state = SearchState({})
    for number in range(settings.evaluations):
        theta = torch.full(problem.sensor.theta_shape, float(number))
        evaluate_theta(problem, theta, state, SearchRun(on_evaluation=run.on_evaluation), "")
    return state.result()

Spiral = Method(search)
"""
FROM_FILE = "over.method=[spiral.py:Spiral]"


def test_a_method_of_a_file_runs_a_request_and_resumes_to_the_same_bytes(tmp_path):
    file = tiny_request(tmp_path)
    write_spiral(tmp_path)
    request = loaded(file, [FROM_FILE, "attack.options.turns=0.25"])
    assert parse_request(request_text(request), folder=tmp_path / "elsewhere") == request_text(request)
    (whole,) = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    (resumed,) = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert resumed.read_bytes() == whole.read_bytes()
    attack, curve = load_attack(whole), json.loads((tmp_path / "whole" / "seed_0.json").read_text())
    assert attack.method == curve["method"] == "Spiral"
    assert len(curve["loss_m"]) == 3
    expected = spiral_theta(attack.face_object.theta.shape, curve["best_evaluation"], turns=0.25)
    torch.testing.assert_close(torch.from_numpy(attack.face_object.theta), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("< settings.evaluations:", "< 2 * settings.evaluations:", r"after 1 to 3 evaluations, .*, got \[8, 8, 3\] after 6"),
        ("return state.result()", "return state.result().theta", "expected a SearchResult with a tensor theta, got Tensor"),
        ("return state.result()", "r = state.result(); return type(r)(r.theta, type(r.best)(**{**vars(r.best), 'values': (9.0,)}), r.history)", "attack method .*Spiral: expected theta to be that of the best evaluation"),
        ("    state = begin", "    problem.start_states.add_(0.3)\n    state = begin", "leave the problem as it is"),
        ("return state.result()", "torch.set_grad_enabled(False); return state.result()", "recording of gradients as it was, on, got off"),
        ("< settings.evaluations:", "< 0:", "expected at least one evaluation before the result"),
    ],
)  # fmt: skip
def test_a_method_that_breaks_the_contract_gives_no_attack(tmp_path, before, after, says):
    file = tiny_request(tmp_path)
    spiral = write_spiral(tmp_path)
    assert before in spiral.read_text()
    spiral.write_text(spiral.read_text().replace(before, after))
    with pytest.raises(AdvnerfError, match=says):
        run_attack(loaded(file, [FROM_FILE]), tmp_path / "out", ProgressDisplay())
    assert not list((tmp_path / "out").glob("*.attack.safetensors"))


def test_a_method_of_an_installed_package_runs_a_request(tmp_path, monkeypatch):
    (tmp_path / "package").mkdir()
    install_method(tmp_path / "package", monkeypatch, spiral_code())
    (file,) = run_attack(
        loaded(tiny_request(tmp_path, 2), ["over.method=[spiral]"]), tmp_path / "out", ProgressDisplay()
    )
    assert load_attack(file).method == "spiral"


def test_another_code_of_the_method_does_not_go_on_with_its_state(tmp_path):
    file = tiny_request(tmp_path)
    spiral = write_spiral(tmp_path)
    request = loaded(file, [FROM_FILE])
    before = prepare(request).settings_hash
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "out", ProgressDisplay(), stop_at_one)
    spiral.write_text(spiral_code().replace("growth: float = 0.2", "growth: float = 0.3"))
    assert prepare(request).settings_hash != before
    with pytest.raises(SearchStateError, match="other settings"):
        run_attack(request, tmp_path / "out", ProgressDisplay())


def test_the_attack_node_shows_a_search_that_keeps_no_state(tmp_path):
    """As the node's worker runs it: nothing to preview from, and an attack file in the end."""
    request = tiny_request(tmp_path, 2)
    (tmp_path / "spiral.py").write_text(FORGETFUL)
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "request.experiment.yaml").write_text(request_text(loaded(request, [FROM_FILE])))
    said = tmp_path / "said"
    with open(said, "wb") as stream:
        work(folder, stream)
    kinds = [json.loads(line)["kind"] for line in said.read_bytes().splitlines()]
    assert kinds == ["progress", "progress", "progress", "done"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            ["over.method=[spirel.py:Spiral]"],
            r"over.method.*: attack method spirel.py:Spiral: expected a Python file at .*spirel.py, found none",
        ),
        (
            ["attack.options.turns=1"],
            "attack.options.turns: expected no option of a listed method, .*got 'turns'; gradient has none",
        ),
        ([FROM_FILE, "attack.together=true"], "gradient method only"),
    ],
)
def test_what_cannot_be_is_told_with_its_place(tmp_path, changes, says):
    write_spiral(tmp_path)
    with pytest.raises(ConfigError, match=says):
        loaded(tiny_request(tmp_path), changes)


def test_a_broken_method_is_one_line_before_anything_is_written(tmp_path, monkeypatch, capsys):
    file = tiny_request(tmp_path)
    (tmp_path / "spiral.py").write_text("turns = 1 / 0\n")
    out = tmp_path / "out"
    assert advnerf(monkeypatch, "attack", "run", file, "-o", out, "--set", FROM_FILE) == 2
    named, said = capsys.readouterr().err.splitlines()
    assert named.startswith("executes ")
    assert "attack method" in said
    assert "cannot be loaded: ZeroDivisionError: division by zero" in said
    assert not list(out.glob("*.yaml"))
    write_spiral(tmp_path)
    with pytest.raises(MethodError, match=r"attack.options.turn: .*did you mean turns"):
        run_attack(loaded(file, [FROM_FILE, "attack.options.turn=1"]), out, ProgressDisplay())
