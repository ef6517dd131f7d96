"""`advnerf attack method check`: what a method promises, met by ours and by the page's, and what is wrong is found."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from advnerf_core.attack.methods import METHODS, MethodError
from nodes.cli.main import app
from nodes.lab.method_check import CHECKS, check_method
from tests.support.strangers import spiral_code

SLOW = ("guided", "distilled")


@pytest.mark.parametrize("name", ["random", "cem", "gradient"])
def test_a_built_in_method_keeps_the_contract(name: str) -> None:
    findings = check_method(name)
    assert [finding.name for finding in findings] == list(CHECKS)
    assert [finding for finding in findings if not finding.met] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in METHODS if name not in ("random", "cem", "gradient", *SLOW)]
)
def test_every_built_in_method_keeps_the_contract(name: str) -> None:
    assert [finding for finding in check_method(name) if not finding.met] == []


def test_the_command_says_what_it_executes_and_takes_options(tmp_path: Path) -> None:
    file = tmp_path / "spiral.py"
    file.write_text(spiral_code())
    done = CliRunner().invoke(app, ["attack", "method", "check", f"{file}:Spiral", "--set", "turns=0.3"])
    assert done.exit_code == 0, done.output
    assert f"executes {file}:Spiral (sha256 " in done.output
    assert done.output.count(" met ") == len(CHECKS)
    with pytest.raises(MethodError, match=r"options.turn: expected .* of turns, growth; got 'turn'"):
        check_method(f"{file}:Spiral", {"turn": 1.0})


@pytest.mark.parametrize(
    ("part", "before", "after", "message"),
    [
        ("budget", "< settings.evaluations", "<= settings.evaluations", "expected 6 evaluations, as Method.evaluations says, got 7"),
        ("budget", "return state.result()", "raise KeyError('x')", "raised KeyError: 'x' (FILE:"),
        ("budget", "return state.result()", "state.result()", "expected search to return a SearchResult with a tensor theta, got NoneType"),
        ("result", "return state.result()", "r = state.result(); return type(r)(r.theta, r.history[0], r.history)", "expected the best evaluation"),
        ("budget", "return state.result()", "raise SystemExit(3)", "raised SystemExit: 3 (FILE:"),
        ("budget", "return state.result()", "torch.set_default_dtype(torch.float64); return state.result()", "torch's default dtype as it was, torch.float32, got torch.float64"),
        ("budget", "    theta = options.growth", "    evaluate(problem, across)\n        theta = options.growth", "expected at most 48 images that the policy is asked about, those of 6 drives, got 96"),
        ("result", "return state.result()", "r = state.result(); return type(r)(-theta, r.best, r.history)", "expected theta to be that of the best evaluation, 0.260"),
        ("result", "    state = begin", "    problem.start_states.add_(0.01)\n    state = begin", "leave the problem as it is"),
        ("seeds", ".manual_seed(run.seed)", ".manual_seed(0)", "expected other textures from seed 4"),
        ("seeds", ", generator=torch.Generator().manual_seed(run.seed)", "", "the same bytes from the same seed"),
        ("resuming", "begin(run.state_path, fingerprint, dict)", "begin(None, fingerprint, dict)", "expected 5 evaluations after 1, got 6"),
        ("state file", "seed=run.seed, ", "", "another seed"),
        ("state file", ", hash=run.settings_hash", "", "another settings_hash"),
        ("needs", "evaluate_theta(problem", "adjoint_gradient(problem, theta); evaluate_theta(problem", "needs_gradient=True"),
        ("writes", "return state.result()", "open('/tmp/h8_left_behind', 'w').close(); return state.result()", "got /tmp/h8_left_behind"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str, before: str, after: str, message: str
) -> None:
    """The part that finds it is looked at alone: the other ones search a dozen times more."""
    monkeypatch.setattr("nodes.lab.method_check.CHECKS", {part: CHECKS[part]})
    code = spiral_code()
    assert before in code
    left = tmp_path.parent / "left_behind"
    code = code.replace(before, after).replace("/tmp/h8_left_behind", str(left))
    file = tmp_path / "spiral.py"
    file.write_text("from advnerf_core.attack.adjoint import adjoint_gradient, evaluate\n" + code)
    (found,) = [finding for finding in check_method(f"{file}:Spiral") if finding.name == part]
    assert not found.met
    assert message.replace("/tmp/h8_left_behind", str(left)).replace("FILE", str(file)) in found.text


def test_theta_of_any_strides_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodes.lab.method_check.CHECKS", {"resuming": CHECKS["resuming"]})
    file = tmp_path / "spiral.py"
    file.write_text(
        spiral_code().replace(
            "        evaluate_theta", "        theta = theta.transpose(0, 1)\n        evaluate_theta"
        )
    )
    assert check_method(f"{file}:Spiral")[0].met
