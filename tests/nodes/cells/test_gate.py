"""The fidelity gate of cells, and predictions, on pictures whose steering is known: a policy that reads it off a pixel."""

import inspect
import json
from typing import get_type_hints

import pytest
import torch
from typer.testing import CliRunner

from advnerf_core.attack.transfer import DEFAULT_DRAWS, FEWEST_DRAWS
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Line, Path
from advnerf_core.driving.rollout import drive
from nodes.cli.experiment import predict
from nodes.cli.main import app
from nodes.experiment.run.plan import statuses
from nodes.experiment.run.predictions import predict_cells, predicted
from nodes.experiment.run.run import Options, run_cells

ONE = {"seed": [0], "method": ["none", "gradient"]}


def run(bench, **options):
    loaded, said = bench.load(), []
    return run_cells(loaded, loaded.cells, Options(here=True, **options), said.append), said


def times_judged(bench):
    return len((bench.folder / "run" / "looked.txt").read_text().splitlines())


def test_a_surrogate_that_the_policy_reads_wrongly_has_its_cells_left_out(gated):
    gated.describe(none_m=2.0, wrong=0.2)
    gated.write(**ONE)
    ended, said = run(gated)
    assert ended == []
    assert gated.calls == []
    reasons = [line for line in said if line.startswith("fidelity gate, straight_hardened")]
    assert said[-1] == "nothing to do: 0 of 2 cells are there"
    assert any("PSNR 13.98 dB" in line for line in reasons)  # a fifth of the range everywhere: 20 log10(5)
    assert any("mean steering difference 0.2000" in line and "--no-gate" in line for line in reasons)
    ended, said = run(gated, gate=False)
    assert {end.how for end in ended} == {"done"}
    assert any("mean steering difference 0.2000" in line for line in said)
    assert times_judged(gated) == 1  # kept


def test_a_surrogate_without_limits_is_not_judged(gated):
    gated.describe(none_m=2.0, wrong=0.2)
    gated.write(gate=None, **ONE)
    assert {end.how for end in run(gated)[0]} == {"done"}
    assert not (gated.folder / "gate").exists()


def test_a_verdict_is_made_again_only_for_other_limits(gated):
    assert {end.how for end in run(gated)[0]} == {"done"}
    verdict = json.loads((gated.folder / "gate" / "straight_hardened.json").read_text())
    assert verdict["passed"]
    assert verdict["numbers"]["views"] == 16
    assert verdict["numbers"]["steering"] == 0.0
    run(gated)
    assert times_judged(gated) == 1
    gated.write(gate={"views": 17}, **ONE)
    _, said = run(gated)
    assert times_judged(gated) == 2
    assert any("16 pictures, at least 17 needed" in line for line in said)
    (gated.folder / "gate" / "straight_hardened.json").write_text("half of it")
    run(gated)
    assert times_judged(gated) == 3


def test_a_published_verdict_on_the_same_scene_and_victim_is_taken_over(gated, monkeypatch):
    """Under the name of any variant: judged on another machine, its last digits differ, and a set has one."""
    monkeypatch.chdir(gated.folder)
    run(gated)
    judged = gated.folder / "gate" / "straight_hardened.json"
    verdict = json.loads(judged.read_text())
    verdict["numbers"]["steering"] = 1e-9
    published = gated.folder / "docs" / "results" / "toy" / "gate" / "straight_too_hardened.json"
    published.parent.mkdir(parents=True)
    published.write_text(json.dumps(verdict))
    judged.unlink()
    run(gated)
    assert times_judged(gated) == 1
    assert json.loads(judged.read_text()) == verdict
    gated.write(gate={"views": 15}, **ONE)
    run(gated)
    assert times_judged(gated) == 2


def test_a_drive_without_attack_is_judged_too_as_soon_as_there_is_one(gated):
    gated.write(**ONE)
    gated.describe(none_m=2.0, late=1.0, wrong_drive=0.2)
    ended, said = run(gated)
    assert {end.how for end in ended} == {"done"}
    assert any(
        "only held-out views are judged" in line and "expected a live drive, got none" in line
        for line in said
    )
    verdict = gated.folder / "gate" / "straight_hardened.drive.json"
    assert not verdict.exists()
    gated.write(seed=[0, 1])
    ended, said = run(gated)
    assert ended == []
    assert any(
        "driven bag: mean steering difference 0.1961" in line and "--no-gate" in line for line in said
    )  # 128 and 178 of 255
    assert json.loads(verdict.read_text())["passed"] is False
    assert len(run(gated, gate=False)[0]) == 1


def test_transfer_is_predicted_from_the_search_before_any_drive(gated):
    gated.write(**ONE)
    loaded = gated.load()
    said = []
    assert predict_cells(loaded, loaded.cells, said.append) == 0
    ended, _ = run(gated, search_only=True)
    assert {end.how for end in ended} == {"done"}
    assert {line.split()[0] for line in gated.calls} == {"search"}
    assert [each.state for each in statuses(loaded, loaded.cells)] == ["begun", "begun"]
    assert predict_cells(loaded, loaded.cells, said.append) == 1  # nothing is predicted of no attack
    assert predict_cells(loaded, loaded.cells, said.append) == 0
    assert predict_cells(loaded, loaded.cells, said.append, draws=9) == 1  # as many as are asked for
    assert predict_cells(loaded, loaded.cells, said.append) == 1
    kept = json.loads((gated.folder / "predictions" / "straight_hardened_gradient_0.json").read_text())
    assert kept["retained"] == pytest.approx(0.5, abs=0.02)
    assert kept["total_cte_m"] == pytest.approx(driven(0.1), rel=0.03)  # half of the attack's 0.2 rad/s
    assert kept["clean_drive"]["steering"] == 0.0
    assert predicted(loaded.folder, []) == []
    run(gated)
    found = [each.result for each in statuses(loaded, loaded.cells) if each.result is not None]
    (pair,) = predicted(loaded.folder, found)
    assert pair.name == "straight_hardened_gradient_0"
    assert pair.expected_m == pytest.approx(kept["excess_m"])
    result = next(each for each in found if each.name == pair.name)
    excess_m = (result.deployed.mean_m - result.deployed.none_total_cte_m[0]) / result.ticks
    assert pair.drives_m == (pytest.approx(excess_m),)


def test_a_search_of_other_settings_is_not_predicted_from(gated):
    gated.write(**ONE)
    run(gated)
    gated.describe(none_m=5.0)
    loaded, said = gated.load(), []
    assert predict_cells(loaded, loaded.cells, said.append) == 0
    run(gated, search_only=True)  # its old result is still there
    assert {each.state for each in statuses(loaded, loaded.cells)} == {"changed"}
    assert predict_cells(loaded, loaded.cells, said.append) == 1


def driven(turn_radps):
    """Total CTE of the drive that the toy's policy makes of pictures with this much added [m]."""

    class Reads:
        stateless = True

        def __call__(self, images, goals=None):
            return images[:, 0, 0, 0]

    def images(states):
        return (-0.5 * states[:, 1] - states[:, 2] + turn_radps)[:, None, None, None]

    rollout = drive(
        Reads(), images, Dubins(1.0, 0.1), torch.tensor([[0.0, 0.3, 0.0]], dtype=torch.float64), 20
    )
    path = Path.from_segments((0.0, 0.0, 0.0), [Line(50.0)], closed=False)
    return drive_metrics(path, rollout.states[:, 0].numpy(), Horizon(20, 0.1, 0.4)).total_cte_m


@pytest.mark.parametrize(("wrong", "code"), [(0.0, 0), (0.2, 1)])
def test_the_gate_is_a_command_of_its_own_with_an_exit_code(gated, wrong, code):
    gated.describe(none_m=2.0, wrong=wrong)
    (gated.folder / "run").mkdir()
    arguments = (
        str(gated.plain()),
        "--folder",
        str(gated.folder / "run"),
    )
    found = CliRunner().invoke(app, ["scene", "gate", *arguments, "--bag", str(gated.file), "--json"])
    assert found.exit_code == code
    verdicts = json.loads(found.stdout)
    assert [verdicts[of]["passed"] for of in ("held-out views", "driven bag")] == [code == 0, True]
    assert verdicts["held-out views"]["numbers"]["steering"] == pytest.approx(wrong, abs=0.002)


def test_the_command_draws_as_often_as_the_library_by_default_and_as_it_must():
    draws = inspect.signature(predict).parameters["draws"]
    (option,) = get_type_hints(predict, include_extras=True)["draws"].__metadata__
    assert (draws.default, option.min) == (DEFAULT_DRAWS, FEWEST_DRAWS)
