"""Rows of the paper's table against counts from the published cells."""

import json
import shutil
from functools import cache, lru_cache

import numpy as np
import pytest

from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.page import searched_apart
from benchmarks.paper_table import PUBLISHED, ledger_rows

cells_of, published_rows = lru_cache(maxsize=1)(read_cells), cache(ledger_rows)

CAR, CAR_SIDES, CAR_LONG, MONITOR, WALL, JUNCTION, SIDES, SPACES = (
    PUBLISHED / f"paper_{name}"
    for name in (
        "car",
        "car_sides",
        "car_long",
        "monitor",
        "monitor_wall",
        "junction",
        "junction_sides",
        "spaces",
    )
)


@pytest.mark.parametrize(
    ("published", "scenario", "changed", "met"),
    [
        (CAR, "green_screen", "", True),
        (CAR, "monitor", "", False),
        (CAR_SIDES, "green_screen", ", one side of the path maximised", False),
        (CAR_LONG, "green_screen", ", one side of the path maximised, searched longer", True),
        (MONITOR, "monitor", ", behind the way of a car that leaves the track", True),
        (WALL, "monitor", ", on the wall", True),
    ],
)
def test_drives_off_the_track_are_those_of_the_cells(published, scenario, changed, met):
    cells = [
        each
        for each in cells_of(published)
        if (each.scenario, each.victim, each.method) == (scenario, "hardened", "gradient")
    ]
    off = [left for cell in cells for left in cell.deployed.off_track]
    hit = [obstacle for cell in cells for obstacle in cell.obstacles("deployed") if obstacle]
    row, unharmed = (
        each for each in published_rows() if scenario.replace("_", " ") + f"{changed}, victim" in each.line
    )
    assert row.value == round(100.0 * sum(off) / len(off))
    assert row.met is met
    assert row.note.startswith(
        f"{sum(off)} of {len(off)} drives of 6 searches; ran into something: {len(hit)}{' (' if hit else ';'}"
    )
    free = [
        left and not drive.collided
        for cell in cells
        for left, drive in zip(cell.deployed.off_track, cell.kept["deployed"], strict=True)
    ]
    least = {"green_screen": 0.8, "monitor": 0.6}[scenario]
    assert unharmed.value == round(100.0 * sum(free) / len(free))
    assert unharmed.met is (sum(free) >= least * len(free))
    assert unharmed.met is (published in (CAR_LONG, WALL))


def test_the_tests_are_those_of_complete_sets(tmp_path):
    row = published_rows()[0]
    tests = [
        each
        for name in (CAR, CAR_SIDES, CAR_LONG, MONITOR, WALL, JUNCTION, SIDES, SPACES)
        for each in json.loads((name / "set" / "set.json").read_text())["primary"]
    ]
    assert (row.value, row.unit, row.met) == (len(tests), f"of {len(tests)}", True)
    assert ledger_rows(tmp_path) == []


def test_assumptions_are_told_also_where_no_attack_was_driven_with_and_without_them(tmp_path):
    name = "imperfect_camera"
    shutil.copytree(PUBLISHED / name, tmp_path / name)
    file = tmp_path / name / "set" / "set.json"
    data = json.loads(file.read_text())
    before = {each.line: (each.value, each.note) for each in ledger_rows(tmp_path)}
    assert len(before) == 2
    assert all("with the other 1 alone" in note for _, note in before.values())
    file.write_text(json.dumps({**data, "contrasts": []}))
    after = {each.line: (each.value, each.note) for each in ledger_rows(tmp_path)}
    assert {line: value for line, (value, _) in after.items()} == {
        line: value for line, (value, _) in before.items()
    }
    assert all("alone" not in note for _, note in after.values())


@pytest.mark.parametrize(
    ("published", "scenario", "met"),
    [
        (JUNCTION, "straight", False),
        (JUNCTION, "right", True),
        (JUNCTION, "left", False),
        (SIDES, "straight", True),
        (SIDES, "left", True),
    ],
)
def test_the_excess_at_the_junction_is_over_the_stronger_control_of_its_cells(published, scenario, met):
    def mean_m(method):
        """Mean |CTE| per tick of each start, over the searches [m]."""
        found = [
            np.divide(each.deployed.total_cte_m, each.ticks)
            for each in cells_of(published)
            if (each.scenario, each.victim, each.method) == (scenario, "hardened", method)
        ]
        return np.mean(found, axis=0)

    controls = {"plain": mean_m("none"), "no": mean_m("empty")}
    stronger = max(controls, key=lambda each: controls[each].mean())
    changed = ", one side of the path maximised" if published is SIDES else ""
    row = next(each for each in published_rows() if f"junction, {scenario}{changed}, victim" in each.line)
    expected_m = (mean_m("gradient") - controls[stronger]).mean()
    assert row.note.startswith(f"{expected_m:.3f} m in the mean over {stronger} objects, 6 searches")
    assert row.value < expected_m
    assert row.met is met


def test_scenarios_that_share_searches_are_one_map():
    def primary(scenario, method, *surrogate_m):
        searches = {method: [{"surrogate_m": value} for value in surrogate_m]}
        return {"test": {"scenario": scenario, "method": method}, "searches": searches}

    shared = [primary("composed", "gradient", 0.1, 0.2), primary("native", "gradient", 0.1, 0.2)]
    assert searched_apart(shared) == shared[1:]
    apart = [primary("screen", "gradient", 0.1, 0.3), primary("screen", "gradient_coarse", 0.4)]
    assert searched_apart([*shared, *apart]) == [shared[1], apart[0]]
