# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)
import csv
import io
import json
from dataclasses import asdict

import pytest
import yaml

from advnerf_core.report.cells import CellError, CellResult, read_cell
from advnerf_core.report.evidence.intervals import clustered_interval
from advnerf_core.report.pages import FirstScreen
from advnerf_core.report.predictions import Predicted, prediction_section
from advnerf_core.report.reference import Reference
from advnerf_core.report.result_page import (
    MAXIMISED,
    as_csv,
    as_json,
    as_markdown,
    gather_clips,
    outcome_of,
    render_page,
    text_table,
)
from advnerf_core.report.result_table import make_table
from advnerf_core.report.targets import Target, evaluate

LIMITS = """
- {scenario: straight, method: gradient, domain: surrogate, at_least: 2.5, paper: "2347 ± 49, 2.01 ×"}
- {scenario: straight, method: gradient, at_least: 2}
- {scenario: straight, method: random, at_most: 1.2, paper: "1193 ± 19, 1.02 ×"}
- {scenario: green_screen, method: random, of: off_track, at_most: 0}
- {scenario: monitor, method: gradient, of: off_track_share, at_least: 0.8}
"""
TICKS = 10
FIRST = FirstScreen("What happened.")


def targets_of(table):
    return evaluate(Reference.model_validate({"targets": yaml.safe_load(LIMITS)}).targets, table)


def wanted_of(cells):
    """The lines that cells make where nobody says what else there should be."""
    seeds = {}
    for each in cells:
        seeds.setdefault(each.key, set()).add(each.seed)
    return {key: sorted(found) for key, found in seeds.items()}


def cell(scenario, method, seed, surrogate, deployed, clip=None, victim="hardened"):
    """Totals ``(attacked, none, off-track)`` of each domain, lists of one entry per start."""
    data = {
        "scenario": scenario,
        "victim": victim,
        "method": method,
        "seed": seed,
        "attack_id": None,
        "settings_hash": "h",
        "seconds": 1.0,
        "machine": "m",
        "date": "2026-11-21",
        "extra": {"clip": clip, "horizon": TICKS},
    }
    for name, drives in (("surrogate", surrogate), ("deployed", deployed)):
        if drives is not None:
            data[name] = dict(zip(("total_cte_m", "none_total_cte_m", "off_track"), drives, strict=True))
    return CellResult.model_validate(data)


WANTED = {("straight", "hardened", method): (0, 1, 2) for method in ("none", "random", "gradient")}


@pytest.fixture
def table():
    cells = [
        cell("straight", "gradient", 0, ([9.0, 11.0], [2.0, 2.0], [True, False]), ([6.0], [2.0], [True])),
        cell("straight", "gradient", 1, ([12.0, 16.0], [4.0, 4.0], [True, True]), ([10.0], [2.0], [False])),
        cell("straight", "random", 0, ([4.0], [4.0], [False]), ([2.8], [2.0], [False])),
        cell("elsewhere", "random", 0, ([4.0], [4.0], [False]), None),
    ]
    return make_table(WANTED, cells, "by hand")


def test_the_lines_by_hand(table):
    row = table.find("straight", "hardened", "gradient", "surrogate")
    assert (row.seeds, row.missing, row.drives, row.off_track) == ((0, 1), (2,), 4, 3)
    assert (row.total_m, row.plain_total_m) == (12.0, 3.0)
    assert row.total_std_m == pytest.approx(8.0**0.5)  # of the seeds' means, 10 and 14
    assert (row.ratio, row.mean_abs_cte_m) == (4.0, pytest.approx(1.2))
    # Each drive against its own start, per tick: 0.7 and 0.9 of one search, 0.8 and 1.2 of the other.
    assert row.excess.excess_m == pytest.approx(0.9)
    deployed = table.find("straight", "hardened", "gradient", "deployed")
    assert deployed.excess.excess_m == pytest.approx((0.4 + 0.8) / 2)
    assert "elsewhere" not in {row.scenario for row in table.rows}


def test_intervals_are_those_of_published_sets_and_starts_are_shared_only_if_they_are():
    none = [2.0, 3.0, 4.0]
    totals = [[9.0, 11.0, 15.0], [10.0, 14.0, 13.0], [12.0, 13.0, 20.0]]
    cells = [
        cell("left", "gradient", seed, (each, none, [True] * 3), None) for seed, each in enumerate(totals)
    ]
    found = make_table(wanted_of(cells), cells).rows[0].excess
    values = [[(a - b) / TICKS for a, b in zip(each, none, strict=True)] for each in totals]
    expected = clustered_interval(values)
    assert (found.low_m, found.high_m, found.over) == (expected.low, expected.high, "searches and starts")
    moved = [
        cell("left", "gradient", seed, (each, [n + seed for n in none], [True] * 3), None)
        for seed, each in enumerate(totals)
    ]
    found = make_table(wanted_of(moved), moved).rows[0].excess
    values = [[v - seed / TICKS for v in each] for seed, each in enumerate(values)]
    expected = clustered_interval(values, shared_starts=False)
    assert (found.low_m, found.high_m) == pytest.approx((expected.low, expected.high))


def test_the_excess_is_over_both_controls_where_no_object_was_driven():
    cells = [
        cell("left", "none", 0, ([2.0, 4.0], [2.0, 4.0], [False] * 2), None),
        cell("left", "empty", 0, ([1.0, 2.0], [2.0, 4.0], [False] * 2), None),
        cell("left", "gradient", 0, ([9.0, 12.0], [2.0, 4.0], [True] * 2), None),
    ]
    table = make_table(wanted_of(cells), cells)
    row = table.find("left", "hardened", "gradient", "surrogate").excess
    assert (row.excess_m, row.over_no_object_m) == (pytest.approx(0.75), pytest.approx(0.9))
    plain = table.find("left", "hardened", "none", "surrogate").excess
    assert (plain.excess_m, plain.over_no_object_m) == (pytest.approx(0.3), pytest.approx(0.15))
    # The plain object has its mean |CTE| and exceeds itself by nothing; one search and no collision make no columns.
    learned = make_table(wanted_of(cells), cells, domains=("surrogate",))
    lines = as_markdown(learned).splitlines()
    line = "| left | hardened | plain object | learned scene | 2 | 0.300 |  |  | 0.150 | -0.485 to 0.785 | 0 of 2 |"
    assert line in lines
    heading = next(each for each in lines if each.startswith("| path"))
    assert "searches" not in heading
    assert "collided" not in heading


def test_what_was_not_run_is_missing_and_never_a_number(table):
    row = table.find("straight", "hardened", "none", "deployed")
    assert (row.total_m, row.ratio, row.total_std_m, row.excess) == (None, None, None, None)
    assert row.missing == (0, 1, 2)
    assert "missing" in as_markdown(table)
    line = next(r for r in csv.DictReader(io.StringIO(as_csv(table))) if r["method"] == "none")
    assert line["total_m"] == line["excess_m"] == ""
    assert line["missing"] == "0 1 2"
    text_table(table).rich()  # its columns agree


def test_a_cell_without_deployment_counts_in_the_surrogate_only():
    half = cell("left", "gradient", 0, ([9.0], [3.0], [True]), None)
    rows = make_table(wanted_of([half]), [half]).rows
    assert [row.ratio for row in rows] == [3.0, None]


def test_a_cell_that_does_not_know_its_ticks_has_totals_and_no_excess():
    old = cell("left", "gradient", 0, ([9.0], [3.0], [True]), None).model_copy(update={"extra": {}})
    row = make_table(wanted_of([old]), [old]).rows[0]
    assert (row.total_m, row.excess, row.mean_abs_cte_m) == (9.0, None, None)


def test_targets_are_met_missed_or_not_measured(table):
    found = {t.what: t for t in targets_of(table)}
    # A seed of each is missing: a value, and no verdict.
    assert {t.met for t in found.values()} == {None}
    learned = "straight, gradient, surrogate: total CTE"
    assert found[learned].value == 4.0
    assert found[learned].verdict == "2 seed(s) so far"
    whole = make_table(wanted_of(table.cells.values()), table.cells.values())
    found = {t.what: t for t in targets_of(whole)}
    assert found[learned].met
    assert found["straight, gradient, deployed: total CTE"].met
    random = found["straight, best random, deployed: total CTE"]
    assert (random.value, random.met) == (1.4, False)
    assert random.verdict == "missed by 17 %"
    assert (random.target, random.paper) == ("≤ 1.2 × plain object", "1193 ± 19, 1.02 ×")
    assert Target(**json.loads(json.dumps(asdict(random)))) == random
    empty = {t.verdict for t in targets_of(make_table(WANTED, []))}
    assert empty == {"not measured"}


def test_the_live_scenarios_have_targets_of_their_own():
    cells = [
        cell("monitor", "gradient", seed, ([9.0], [2.0], [True]), ([8.0], [2.0], [seed < 4]))
        for seed in range(5)
    ]
    cells.append(cell("green_screen", "random", 0, ([2.0], [2.0], [False]), ([2.0], [2.0], [True])))
    found = {t.what: t for t in targets_of(make_table(wanted_of(cells), cells))}
    assert found["monitor, gradient, deployed: share of drives off the track"].met
    assert found["green_screen, best random, deployed: drives off the track"].met is False


def test_json_and_page_hold_the_same_numbers(table):
    data = json.loads(json.dumps(as_json(table, targets_of(table)), allow_nan=False))
    assert len(data["rows"]) == 6
    assert data["targets"][0]["value"] == 4.0
    assert set(data["cells"]) == set(table.cells)
    page = render_page(table, FIRST, targets=targets_of(table))
    assert "0.900" in page
    assert "4.00 × plain object" in page
    assert "missing" in page
    assert "http" not in page.replace("http-equiv", "")


def test_what_was_maximised_is_named_with_its_values_unless_it_is_the_total(table):
    assert "objectives" not in as_json(table)
    assert MAXIMISED not in as_markdown(table) + render_page(table, FIRST)
    goal = {"name": "Turn", "unit": "deg"}
    values = ({"value": -8.0, "clean_value": -9.0}, {"value": -5.0, "clean_value": -7.0}, {"value": 1.5})
    cells = [
        each.model_copy(update={"extra": {**each.extra, "objective": {**goal, **value}}})
        for each, value in zip(table.cells.values(), values, strict=True)
    ]
    found = make_table(WANTED, cells, "by hand")
    two, one = as_json(found)["objectives"]
    assert two == {
        **{"scenario": "straight", "victim": "hardened", "method": "gradient", "searches": 2},
        **{"objective": "Turn", "unit": "deg", "value": -6.5, "clean_value": -8.0},
    }
    assert (one["method"], one["value"], one["clean_value"]) == ("random", 1.5, None)
    assert "| straight | hardened | gradient | Turn | 2 | -6.5 | -8 | deg |" in as_markdown(found)
    page = render_page(found, FIRST)
    assert all(text in page for text in (MAXIMISED, "Turn", "-6.5", "deg"))


def test_clips_are_grouped_by_outcome(tmp_path):
    strayed = cell("straight", "gradient", 0, ([3.0], [1.0], [False]), ([3.0], [1.0], [False]), "a/clip.mp4")
    left = cell("left", "gradient", 0, ([3.0], [1.0], [False]), ([3.0], [1.0], [True]), "b/clip.mp4")
    gone = cell("right", "gradient", 0, ([3.0], [1.0], [False]), None, "c/clip.mp4")
    held = cell("right", "random", 0, ([1.1], [1.0], [False]), None)
    assert [outcome_of(each) for each in (strayed, left, gone, held)] == [
        "strayed",
        "left the track",
        "strayed",
        "held its course",
    ]
    crashed = strayed.model_copy(update={"extra": {"blocked_tick": [None, 42]}})
    assert outcome_of(crashed) == "ran into something"
    assert outcome_of(left.model_copy(update={"extra": crashed.extra})) == "left the track"
    assert outcome_of(strayed.model_copy(update={"extra": {"blocked_tick": [None]}})) == "strayed"
    for name in "ab":
        (tmp_path / "cells" / name).mkdir(parents=True)
        (tmp_path / "cells" / name / "clip.mp4").write_bytes(name.encode())
    cells = [strayed, left, gone, held]
    shown = gather_clips(make_table(wanted_of(cells), cells), tmp_path / "cells", tmp_path / "page")
    assert shown == {
        "left the track": {"videos/left_the_track/left_hardened_gradient_0.mp4": left},
        "strayed": {"videos/strayed/straight_hardened_gradient_0.mp4": strayed},
    }
    assert all((tmp_path / "page" / file).is_file() for found in shown.values() for file in found)
    page = render_page(make_table(wanted_of(cells), cells), FIRST, shown)
    assert "<h3>Left the track (1)</h3>" in page
    assert "seed 0: total CTE 3.00 m, without attack 1.00 m" in page


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda d: d.pop("victim"), "victim"),
        (lambda d: d["surrogate"].update(total_cte_m=[1.0, 2.0]), "for each of 2 drives"),
        (lambda d: d["surrogate"].update(total_cte_m=[float("nan")]), "surrogate"),
        (lambda d: d.update(seed="x"), "seed"),
    ],
)
def test_a_bad_cell_is_one_clear_error(tmp_path, damage, says):
    data = cell("straight", "random", 0, ([1.0], [1.0], [False]), None).model_dump(mode="json")
    damage(data)
    file = tmp_path / "cell.json"
    file.write_text(json.dumps(data))
    with pytest.raises(CellError, match=says) as error:
        read_cell(file)
    assert str(file) in str(error.value)
    file.write_text("{")
    with pytest.raises(CellError, match="cannot be read"):
        read_cell(file)


def test_predictions_are_scored_by_hand():
    pairs = [
        Predicted("a", "gradient", 0.4, 0.3, 0.5, 1.0, 0.6, (0.35, 0.45)),
        Predicted("b", "random", 0.1, 0.0, 0.2, 0.8, 0.1, (0.3,)),
    ]
    section = prediction_section(pairs)
    # Two of three are within; the third is 0.1 outside: its score is 0.2 + 10 x 0.1, that of the others their width of 0.2.
    assert "2 of 3 drives are within their 80 % bands" in section
    assert "interval score is 0.533 m per tick" in section
    # Expected is off by 0 and 0.2, the learned scene by 0.2 and 0.2.
    assert "off by 0.100 m in the median" in section
    assert "would be off by 0.200 m" in section
    assert "No attack was both" in prediction_section([])


@pytest.mark.parametrize(
    ("limit", "says"),
    [
        ({"method": "gradient"}, "one of at_least, at_most and above, got 0"),
        ({"method": "gradient", "at_least": 1, "above": "random"}, "got 2"),
        ({"method": "gradient", "at_least": 1, "of": "luck"}, "of"),
        ({"of": "ratio", "at_least": 1}, "expected a method with excess_m"),
        ({"of": "laps", "method": "gradient", "at_least": 1}, "and with nothing else, got laps of gradient"),
    ],
)
def test_a_limit_that_says_nothing_or_two_things_is_refused(limit, says):
    with pytest.raises(ValueError, match=says):
        Reference.model_validate({"targets": [limit]})


def test_a_method_must_exceed_another_one_not_equal_it():
    limits = Reference.model_validate(
        {"targets": [{"method": "gradient", "of": "excess_m", "above": "random"}]}
    )
    for gradient_m, met in ((6.0, True), (4.0, False), (3.0, False)):
        cells = [
            cell("left", name, 0, ([1.0], [1.0], [False]), ([total], [1.0], [False]))
            for name, total in (("random", 4.0), ("gradient", gradient_m))
        ]
        (target,) = evaluate(limits.targets, make_table(wanted_of(cells), cells))
        assert (target.target, target.met) == ("> random 0.30", met)
    alone = make_table(wanted_of(cells[1:]), cells[1:])
    assert [target.met for target in evaluate(limits.targets, alone)] == [None]


def test_without_limits_there_are_no_targets(table):
    assert "Targets" not in render_page(table, FIRST)
    assert "Targets" not in as_markdown(table)


def test_a_cell_that_was_not_driven_live_is_named_first():
    late = cell("left", "gradient", 0, ([9.0], [3.0], [True]), None)
    late = late.model_copy(update={"not_driven_live": "the stack stopped the car"})
    page = render_page(make_table(wanted_of([late]), [late]), FIRST, notes=("What is left out.",))
    assert page.index("NOT DRIVEN LIVE: gradient (hardened, seed 0)") < page.index("What is left out.")
    assert page.index("What is left out.") < page.index("<h1>")
    assert "are no evidence of transfer" in page
