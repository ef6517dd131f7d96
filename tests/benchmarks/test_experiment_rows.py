"""What the benchmarks of the junction make of finished cells: the figures by hand, and no verdict on too few seeds."""

import pytest

from advnerf_core.report.cells import CellResult
from advnerf_core.report.transfer import Wanted, make_table
from benchmarks import black_box, mesh_attack, pose_attacks, retraining, transfer_table
from benchmarks.black_box import Search


def cell(seed, method, deployed_m, none_m=2.0):
    drives = {"total_cte_m": [deployed_m], "none_total_cte_m": [none_m], "off_track": [False]}
    return {
        "scenario": "right", "victim": "hardened", "method": method, "seed": seed, "attack_id": None, "settings_hash": "h",
        "seconds": 1.0, "machine": f"machine {seed}", "date": "2026-11-21", "surrogate": drives, "deployed": drives,
    }  # fmt: skip


def test_a_retrained_policy_is_held_against_the_original_undisturbed():
    drive = {
        "original_undisturbed_m": 2.0,
        "original_attacked_m": 9.0,
        "retrained_undisturbed_m": 1.0,
        "retrained_attacked_m": 2.2,
    }
    rounds = [{"victim": "a" * 64, "surrogate": {"right": 5.0}, "deployed": {"right": 4.0}}]
    summary = {"old_attacks": {"right": {**drive, "ratio": 1.1}, "left": {**drive, "ratio": 1.11}}, "rounds": rounds}
    rows = {line: (value, met) for line, value, _, _, met, _ in retraining.rows_of(summary)}
    assert rows["#5 retrained under the old attack, right, over the original undisturbed"] == (1.1, True)
    assert rows["#5 retrained under the old attack, left, over the original undisturbed"] == (1.11, False)
    assert rows["#5 attack -> retrain -> attack, round 0, right, deployed"] == (4.0, None)


def test_ratios_of_meshes_are_of_means_and_have_no_spread_over_one_seed():
    value, spread, base_m = mesh_attack.ratio([cell(0, "gradient", 6.0), cell(1, "gradient", 10.0)], "deployed")
    assert (value, base_m) == (4.0, 2.0)
    assert spread == pytest.approx(8.0**0.5 / 2.0)
    assert mesh_attack.ratio([cell(0, "gradient", 6.0)], "deployed")[1] is None


def test_totals_of_places_are_told_seed_by_seed():
    cells = [cell(0, "random", 3.0), cell(1, "random", 5.0)]
    assert pose_attacks.total_m(cells, "deployed") == 4.0
    assert pose_attacks.spread_of(cells) == "2 seed(s): 3.0 m, 5.0 m"


def test_a_row_of_the_table_has_its_machines_and_waits_for_its_seeds():
    cells = [CellResult.model_validate(cell(seed, "gradient", 9.0)) for seed in (0, 1)]
    table = make_table([Wanted("right", "", "hardened", "gradient", (0, 1, 2))], cells)
    rows = transfer_table.rows_of(table)
    assert [(row.domain, row.ratio, target.met) for row, target in rows] == [
        ("surrogate", 4.5, None),
        ("deployed", 4.5, None),
    ]
    note = transfer_table.note_of(rows[0][0], table.cells_of(rows[0][0]))
    assert "seeds 2 are missing" in note
    assert "machine 0, machine 1" in note
    whole = make_table([Wanted("right", "", "hardened", "gradient", (0, 1))], cells)
    assert [target.met for _, target in transfer_table.rows_of(whole)] == [True, True]


def test_a_miss_says_by_how_much_and_what_that_is_on_the_road():
    extra = {"extra": {"horizon": 60}}
    cells = [CellResult.model_validate({**cell(seed, "random", 3.0), **extra}) for seed in (0, 1)]
    cells += [CellResult.model_validate({**cell(seed, "none", 2.0), **extra}) for seed in (0, 1)]
    table = make_table([Wanted("right", "", "hardened", method, (0, 1)) for method in ("none", "random")], cells)
    rows = dict((row.domain, (row, target)) for row, target in transfer_table.rows_of(table))
    row, target = rows["deployed"]
    none = table.find("right", "hardened", "none", "deployed")
    why = transfer_table.why_missed(target, row, none, table.cells_of(row))
    assert "missed by 25 %: 50 mm off the path on average, 33 mm without attack" in why
    assert transfer_table.why_missed(None, row, none, []) == ""


def test_shares_of_the_white_box_are_of_what_it_adds(tmp_path):
    search = Search("guided", tmp_path, 10)
    search.curve = [[100, 3.0, 1.0, 300], [200, 6.0, 1.0, 1200]]
    table = black_box.shares([search], 100, none_m=2.0, white_m=10.0)
    assert table["guided"]["1"] == pytest.approx(0.125)
    assert table["guided"]["10"] == pytest.approx(0.5)
    assert "50" not in table["guided"]  # it has not come so far
