"""What the benchmarks of the junction make of finished cells: the figures by hand, and no verdict on too few seeds."""

import json
from pathlib import Path

import pytest
import yaml

from advnerf_core.report.cells import CellResult
from advnerf_core.report.reference import DOMAINS, Reference
from advnerf_core.report.result_table import make_table
from advnerf_core.report.targets import evaluate
from benchmarks import black_box, experiment_rows, first_build_ratios, retraining, transfer_table
from benchmarks.black_box import Search

ROOT = Path(__file__).parents[2]
FILE = ROOT / "launch" / "meshes_and_poses.reference.yaml"
LIMITS = Reference.model_validate(yaml.safe_load(FILE.read_text())).targets


def rows_of(table, limits=LIMITS):
    return transfer_table.rows_of(table, limits)


def cell(seed, method, deployed_m, none_m=2.0):
    drives = {"total_cte_m": [deployed_m], "none_total_cte_m": [none_m], "off_track": [False]}
    return {
        "scenario": "right_texture",
        "victim": "hardened",
        "method": method,
        "seed": seed,
        "attack_id": None,
        "settings_hash": "h",
        "seconds": 1.0,
        "machine": f"machine {seed}",
        "date": "2026-11-21",
        "surrogate": drives,
        "deployed": drives,
    }


def test_a_retrained_policy_is_held_against_the_original_undisturbed():
    drive = {
        "original_undisturbed_m": 2.0,
        "original_attacked_m": 9.0,
        "retrained_undisturbed_m": 1.0,
        "retrained_attacked_m": 2.2,
    }
    rounds = [{"victim": "a" * 64, "surrogate": {"right": 5.0}, "deployed": {"right": 4.0}}]
    old = {"right": {**drive, "ratio": 1.1}, "left": {**drive, "ratio": 1.11}}
    summary = {"old_attacks": old, "rounds": rounds, "pays_ratio": 1.5}
    rows = {line: (value, met) for line, value, _, _, met, _ in retraining.rows_of(summary, 0)}
    assert rows["retrained under the old attack, right, over the original undisturbed"] == (1.1, True)
    assert rows["retrained under the old attack, left, over the original undisturbed"] == (1.11, False)
    assert rows["attack -> retrain -> attack, round 0, right, deployed"] == (4.0, None)
    assert "the number of rounds ended the loop" in retraining.rows_of(summary, 0)[-1][-1]
    assert "stopped before its 6 rounds were over" in retraining.rows_of(summary, 6)[-1][-1]
    cured = retraining.rows_of({**summary, "pays_ratio": 5.1}, 6)[-1][-1]
    assert "ended" not in cured
    assert "stopped" not in cured


def test_rounds_and_their_curve_are_published_as_they_were_found(tmp_path):
    rounds = [{"victim": "a" * 64, "surrogate": {"right": 5.0}, "deployed": {"right": 4.0}}]
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "retrain.json").write_text(json.dumps({"rounds": rounds, "pays_ratio": 1.5}))
    retraining.publish(tmp_path / "found", tmp_path / "docs")
    kept = tmp_path / "docs" / "results" / "retrain" / "retrain.json"
    assert json.loads(kept.read_text())["rounds"] == rounds
    assert (tmp_path / "docs" / "retraining.png").read_bytes().startswith(b"\x89PNG")


def test_a_row_of_the_table_has_its_machines_and_waits_for_its_seeds():
    cells = [CellResult.model_validate(cell(seed, "gradient", 9.0)) for seed in (0, 1)]
    table = make_table({("right_texture", "", "hardened", "gradient"): (0, 1, 2)}, cells)
    limit = {"scenario": "right_texture", "method": "gradient", "at_least": 2.5}
    limits = Reference.model_validate(
        {"targets": [{**limit, "domain": domain} for domain in DOMAINS]}
    ).targets
    rows = rows_of(table, limits)
    assert [(row.domain, row.ratio, target.met) for row, _, target in rows] == [
        ("surrogate", 4.5, None),
        ("deployed", 4.5, None),
    ]
    note = transfer_table.note_of(rows[0][0], transfer_table.cells_of(table, rows[0][0]))
    assert "seeds 2 are missing" in note
    assert transfer_table.measured_where(cells) == {"machine": "machine 0; machine 1", "date": "2026-11-21"}
    assert "total CTE 9.00 +- 0.00 m of 2.00 m" in note
    assert "by seed 4.50, 4.50 x" in note
    assert "the same start" in note
    other = [cells[0], CellResult.model_validate(cell(1, "gradient", 9.0, none_m=3.0))]
    assert "the same start" not in transfer_table.note_of(rows[0][0], other)
    assert "builds" not in note
    anew = [cells[0], cells[1].model_copy(update={"stages": {"scene": "s1"}})]
    assert "seeds are of 2 builds of scene and policies" in transfer_table.note_of(rows[0][0], anew)
    whole = make_table({("right_texture", "", "hardened", "gradient"): (0, 1)}, cells)
    assert [target.met for _, _, target in rows_of(whole, limits)] == [True, True]


def test_shares_of_the_white_box_are_of_what_it_adds(tmp_path):
    search = Search("guided", tmp_path, 10)
    search.curve = [[100, 3.0, 1.0, 300], [200, 6.0, 1.0, 1200]]
    table = black_box.shares([search], 100, none_m=2.0, white_m=10.0)
    assert table["guided"]["1"] == pytest.approx(0.125)
    assert table["guided"]["10"] == pytest.approx(0.5)
    assert "50" not in table["guided"]  # it has not come so far


def test_a_missed_target_says_by_how_much_and_what_it_points_to():
    cells = [
        CellResult.model_validate({**cell(seed, "gradient", 6.0), "scenario": "straight_shape_1m"})
        for seed in (0, 1)
    ]
    table = make_table({("straight_shape_1m", "", "hardened", "gradient"): (0, 1)}, cells)
    ((row, _, target),) = [each for each in rows_of(table) if each[0].domain == "deployed"]
    assert transfer_table.base_m(cells, "deployed") == 2.0
    text = transfer_table.why_missed(target, row)
    assert text.startswith("; missed by 70 %; tried: ")
    assert "points to" in text


def test_places_must_beat_random_ones_on_the_retrained_victim():
    def places(method, deployed_m):
        data = {**cell(0, method, deployed_m), "scenario": "left_places", "victim": "retrained"}
        return CellResult.model_validate(data)

    wanted = {("left_places", "", "retrained", method): (0,) for method in ("random", "gradient")}
    for gradient_m, met in ((6.0, True), (4.0, False), (3.0, False)):
        table = make_table(wanted, [places("random", 4.0), places("gradient", gradient_m)])
        found = {(row.method, row.domain): target for row, _, target in rows_of(table)}
        assert found["random", "deployed"] is found["gradient", "surrogate"] is None
        assert (found["gradient", "deployed"].target, found["gradient", "deployed"].met) == (
            "> random 2.00",
            met,
        )
    assert [target.met for target in evaluate(LIMITS, make_table(wanted, []))] == [None]
    alone = make_table(wanted, [places("gradient", 9.0)])
    assert [target.met for row, _, target in rows_of(alone) if row.domain == "deployed"] == [None]


def test_rows_of_the_gate_come_from_what_was_published(tmp_path):
    (tmp_path / "gate").mkdir()
    numbers = {
        "views": 12,
        "psnr_db": 27.5,
        "ssim": 0.9,
        "steering": 0.1,
        "steering_worst": 0.2,
        "correlation": 0.99,
    }
    verdict = {"key": "k", "passed": False, "reasons": ["steering too far off"], "numbers": numbers}
    (tmp_path / "gate" / "right_hardened.json").write_text(json.dumps(verdict))
    (tmp_path / "gate" / "right_hardened.drive.json").write_text(
        json.dumps({**verdict, "passed": True, "reasons": []})
    )
    (_, (line, value, unit, _, met, note)), (key, drive) = transfer_table.gate_rows(
        tmp_path, ["right_hardened"]
    )
    assert transfer_table.gate_rows(tmp_path, ["left_hardened"]) == []
    assert (key, drive[0], drive[4]) == (
        "right_hardened",
        "fidelity gate, right_hardened, drive without attack",
        True,
    )
    assert (line, value, unit, met) == (
        "fidelity gate, right_hardened, held-out views",
        27.5,
        "dB PSNR",
        False,
    )
    assert "steering too far off" in note


def test_the_interval_of_few_seeds_is_their_range_and_the_transfer_is_from_shared_starts():
    data = [cell(seed, "gradient", total) for seed, total in enumerate((6.0, 8.0, 9.0))]
    cells = [CellResult.model_validate(each) for each in data]
    assert first_build_ratios.seeds_interval([each.deployed for each in cells]) == (3.0, 4.5)
    assert first_build_ratios.seeds_interval([cells[0].deployed]) is None
    more = {"total_cte_m": [3.0, 90.0], "none_total_cte_m": [2.0, 1.0], "off_track": [True, True]}
    longer = CellResult.model_validate({**data[0], "surrogate": more})
    assert first_build_ratios.transfer_ratio([longer]) == 2.0


def test_every_measured_target_of_a_report_is_a_row():
    target = {"what": "laps", "value": 3.0, "measured": "3 laps", "target": "≥ 3 laps", "met": True}
    report = {
        "rows": [{"method": "none", "domain": "deployed", "drives": 3}],
        "targets": [target, {**target, "value": None}],
    }
    rows = []
    experiment_rows.record_targets(report, lambda *row: rows.append(row))
    assert rows == [("laps", 3.0, "laps", ">= 3 laps", True, "drives: none deployed 3")]
