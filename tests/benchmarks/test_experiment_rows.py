"""What the benchmarks of the junction make of finished cells: the figures by hand, and no verdict on too few seeds."""

import json

import pytest

from advnerf_core.policies.policy_file import load_policy
from benchmarks import black_box, experiment_rows, kept_rows, retraining
from benchmarks.black_box import Search


def test_retrained_policies_are_held_against_the_originals_undisturbed():
    drive = {
        "original_undisturbed_m": 2.0,
        "original_attacked_m": 9.0,
        "retrained_undisturbed_m": 1.0,
        "retrained_attacked_m": 2.2,
    }
    rounds = [
        {
            "victim": "a" * 64,
            "surrogate": {"right": 5.0, "left": 0.1},
            "deployed": {"right": 4.0, "left": 0.0},
        }
    ]
    old = {"right": {**drive, "ratio": 1.1}, "left": {**drive, "ratio": 1.11}}
    first = {"old_attacks": old, "rounds": rounds, "pays_m": 0.175}
    rows = {row.line: (row.value, row.met) for row in retraining.rows_of([first])}
    assert rows["retrained once, under the old attack, right, over the original undisturbed"] == (1.1, True)
    assert rows["retrained once, under the old attack, left, over the original undisturbed"] == (1.11, False)
    assert rows["attack on the policy after 0 rounds of retraining, right, deployed"] == (4.0, None)
    cured = {
        "victim": "b" * 64,
        "surrogate": {"right": 0.1, "left": 0.0},
        "deployed": {"right": 0.2, "left": 0.1},
    }
    second = {
        "old_attacks": {"right": {**drive, "ratio": 0.9}, "left": {**drive, "ratio": 1.01}},
        "rounds": [{**cured, "deployed": {"right": 2.0, "left": 1.0}}, cured],
        "pays_m": 0.175,
    }
    both = {row.line: (row.value, row.met, row.note) for row in retraining.rows_of([first, second])}
    ratio, met, note = both["retrained once, under the old attack, left, over the original undisturbed"]
    assert (ratio, met) == (pytest.approx(1.06), True)
    assert "seeds in turn: 1.110, 1.010" in note
    value, _, note = both["attack on the policy after 0 rounds of retraining, right, deployed"]
    assert value == pytest.approx(3.0)
    assert "seeds 0, 1: 4.000, 2.000 m" in note
    assert "an attack pays on 1 of 2" in note
    value, _, note = both["attack on the policy after 1 round of retraining, right, deployed"]
    assert value == 0.2  # of the seed that came so far
    assert note.startswith("seed 1: 0.200 m")
    assert "victims bbbbbbbbbbbb; an attack pays on 0 of 1" in note


def test_rounds_are_published_as_they_were_found(tmp_path):
    rounds = [{"victim": "a" * 64, "surrogate": {"right": 5.0}, "deployed": {"right": 4.0}}]
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "retrain.json").write_text(json.dumps({"rounds": rounds, "pays_m": 0.175}))
    (tmp_path / "original.safetensors").write_bytes(b"weights")
    retraining.publish(tmp_path / "found", tmp_path / "original.safetensors", tmp_path / "docs")
    assert (tmp_path / "docs" / "results" / "retrain" / "policy_0.safetensors").read_bytes() == b"weights"
    kept = tmp_path / "docs" / "results" / "retrain" / "retrain.json"
    assert json.loads(kept.read_text())["rounds"] == rounds


def test_shares_of_the_white_box_are_of_what_it_adds(tmp_path):
    search = Search("guided", tmp_path, 10)
    search.curve = [[100, 3.0, 1.0, 300], [200, 6.0, 1.0, 1200]]
    table = black_box.shares([search], 100, none_m=2.0, white_m=10.0)
    assert table["guided"]["1"] == pytest.approx(0.125)
    assert table["guided"]["10"] == pytest.approx(0.5)
    assert "50" not in table["guided"]  # it has not come so far


def test_every_measured_target_of_a_report_is_a_row():
    target = {"what": "laps", "value": 3.0, "measured": "3 laps", "target": "≥ 3 laps", "met": True}
    report = {
        "rows": [{"method": "none", "domain": "deployed", "drives": 3}],
        "targets": [target, {**target, "value": None}],
    }
    rows = []
    experiment_rows.record_targets(report, lambda *row: rows.append(row))
    assert rows == [("laps", 3.0, "laps", ">= 3 laps", True, "drives: none deployed 3")]


def test_the_policies_of_the_published_rounds_are_kept():
    folder = kept_rows.PUBLISHED / "retrain"
    rounds = json.loads((folder / "retrain.json").read_text())["rounds"]
    kept = [load_policy(folder / f"policy_{number}.safetensors").sha256 for number in range(len(rounds))]
    assert kept == [each["victim"] for each in rounds]
