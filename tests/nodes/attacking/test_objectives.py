"""An objective that a user brings is what a request maximises."""

import json
from dataclasses import replace

import pytest
import torch

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.artifact import load_attack
from nodes.experiment.node.check import check, write_check
from nodes.experiment.node.prepare import prepare, request_text
from nodes.experiment.node.printed import in_one_line
from nodes.experiment.node.request import parse_request
from nodes.experiment.node.search import run_attack
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay
from tests.support.tiny_request import loaded, tiny_request

LEFT = """
from advnerf_core.attack.objective import Objective

class Left(Objective):
    def value(self, drives):
        return drives.cte_m.clamp(min=0.0).sum(0)
"""


def test_a_request_is_chosen_by_the_objective_of_a_file_and_reports_the_total_too(tmp_path):
    file = tiny_request(tmp_path)
    (tmp_path / "mine.py").write_text(LEFT)
    request = loaded(file, ["attack.objective=mine.py:Left", "over.method=[random]"])
    assert parse_request(request_text(request), folder=tmp_path / "elsewhere") == request_text(request)
    (found,) = run_attack(request, tmp_path / "run", ProgressDisplay())
    attack, curve = load_attack(found), json.loads(found.with_name("seed_0.json").read_text())
    problem = prepare(request).problem
    rollout, totals = evaluate(problem, torch.from_numpy(attack.objects[0].theta))
    left_m = problem.path.project(rollout.states[1:, :, :2].numpy()).cte_m.clip(min=0.0).sum(0)
    clean, _ = evaluate(problem, problem.sensor.plain_theta())
    clean_m = problem.path.project(clean.states[1:, :, :2].numpy()).cte_m.clip(min=0.0).sum(0).mean()
    entry = attack.extra["objective"]
    assert entry == {"name": "Left", "unit": "m", "value": attack.value, "clean_value": entry["clean_value"]}
    assert entry["clean_value"] == pytest.approx(clean_m, rel=1e-6)
    told = f", random, Left {left_m.mean():.4g} m, without attack {clean_m:.4g} m; predicted total CTE "
    assert told in in_one_line(attack)
    assert attack.value == pytest.approx(left_m.mean(), rel=1e-6)
    assert attack.value == max(curve["value"])
    assert attack.predicted_total_cte_m == pytest.approx(float(totals.protocol_cte_m.mean()), rel=1e-6)


def hash_with(file, changes):
    return prepare(loaded(file, changes)).settings_hash


def test_its_hash_follows_the_code_and_cte_leaves_it_unchanged(tmp_path):
    file, own = tiny_request(tmp_path), tmp_path / "mine.py"
    own.write_text(LEFT)
    plain = hash_with(file, [])
    assert hash_with(file, ["attack.objective=cte"]) == plain
    hashes = [hash_with(file, ["attack.objective=mine.py:Left"])]
    own.write_text(LEFT.replace("min=0.0", "min=0.1"))
    hashes.append(hash_with(file, ["attack.objective=mine.py:Left"]))
    hashes.append(hash_with(file, ["attack.objective=peak"]))
    assert len({plain, *hashes}) == 4


def test_wrong_objectives_are_one_line_before_anything_is_loaded(tmp_path):
    file = tiny_request(tmp_path)
    with pytest.raises(
        ConfigError, match=r"objective.*expected an objective of cte, .*got 'tce' .did you mean cte"
    ):
        loaded(file, ["attack.objective=tce"])
    with pytest.raises(ConfigError, match="expected an objective that needs no solids"):
        loaded(file, ["attack.objective=collision"])
    (tmp_path / "mine.py").write_text(LEFT.replace("def value", "needs_solids = True\n\n    def value"))
    request = loaded(file, ["attack.objective=mine.py:Left"])
    with pytest.raises(ConfigError, match="expected an objective that needs no solids"):
        run_attack(request, tmp_path / "run", ProgressDisplay())
    assert not (tmp_path / "run").exists()


def test_the_check_says_adjoints_in_the_unit_of_the_objective(tmp_path):
    file, found = tiny_request(tmp_path), {}
    for unit, per_m in (("m", 1.0), ("cm", 100.0)):
        own = LEFT.replace("    def", f"    unit = {unit!r}\n\n    def").replace(
            ".sum(0)", f".sum(0) * {per_m}"
        )
        (tmp_path / f"in_{unit}.py").write_text(own)
        request = loaded(file, [f"attack.objective=in_{unit}.py:Left"])
        found[unit] = check(request, 2, False, lambda fraction, text="": None)
    start = found["m"].ticks.lambda_yaw[0]
    assert start > 0.0
    assert any(f"yaw: {100.0 * start:.3g} cm/rad at the start" in line for line in found["cm"].verdict)
    pictures = [
        write_check(replace(found["cm"], unit=unit), tmp_path / name)[1].read_bytes()
        for name, unit in (("a", "cm"), ("b", "cm"), ("c", "deg"))
    ]
    assert pictures[0] == pictures[1] != pictures[2]
