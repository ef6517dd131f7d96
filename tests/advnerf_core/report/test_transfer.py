import csv
import io
import json
from pathlib import Path

import pytest
import yaml

from advnerf_core.report.cells import CellError, CellResult, read_cell
from advnerf_core.report.reference import Reference
from advnerf_core.report.transfer import Wanted
from advnerf_core.report.transfer import make_table as table_of
from advnerf_core.report.transfer_page import (
    as_csv,
    as_json,
    as_markdown,
    gather_clips,
    outcome_of,
    render_transfer_page,
    text_table,
)
from advnerf_core.report.transfer_prediction import Predicted, prediction_section, skill_of
from advnerf_core.report.transfer_targets import table_targets

ROOT = Path(__file__).parents[3]
PAPER = Reference.model_validate(yaml.safe_load((ROOT / "launch" / "paper.reference.yaml").read_text()))


def make_table(wanted, cells, name=""):
    """Held against what the shipped campaigns are held against."""
    return table_of(wanted, cells, name, PAPER)


def wanted_of(cells):
    """The lines that cells make where nobody says what else there should be."""
    seeds = {}
    for each in cells:
        seeds.setdefault((each.scenario, each.placement, each.victim, each.method), set()).add(each.seed)
    return [Wanted(*key, tuple(sorted(found))) for key, found in seeds.items()]


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
        "extra": {"clip": clip},
    }
    for name, drives in (("surrogate", surrogate), ("deployed", deployed)):
        if drives is not None:
            data[name] = dict(zip(("total_cte_m", "none_total_cte_m", "off_track"), drives, strict=True))
    return CellResult.model_validate(data)


WANTED = [Wanted("straight", "", "hardened", method, (0, 1, 2)) for method in ("none", "random", "gradient")]


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
    assert row.mean_m == 12.0  # means of the seeds: 10 and 14
    assert row.std_m == pytest.approx(8.0**0.5)
    assert row.ratio == 4.0  # 48 over 12
    assert (row.ratio_interval.low, row.ratio_interval.high) == (3.5, 5.0)
    deployed = table.find("straight", "hardened", "gradient", "deployed")
    assert deployed.ratio == 4.0
    # Deployed from the first start only, so from that one in the surrogate: 16 over 4, and 21 over 6.
    assert deployed.transfer == pytest.approx(4.0 / 3.5)
    # Seed 0 alone: 3 over 4.5; seed 1 alone: 5 over 3.
    assert (deployed.transfer_interval.low, deployed.transfer_interval.high) == pytest.approx(
        (3.0 / 4.5, 5.0 / 3.0)
    )
    assert (deployed.paper_m, deployed.paper_std_m) == (1702, 160)
    assert deployed.paper_ratio == pytest.approx(1702 / 1166)
    assert "elsewhere" not in {row.scenario for row in table.rows}


def test_what_was_not_run_is_missing_and_never_a_number(table):
    row = table.find("straight", "hardened", "none", "deployed")
    assert (row.mean_m, row.ratio, row.std_m, row.transfer, row.missing) == (
        None,
        None,
        None,
        None,
        (0, 1, 2),
    )
    assert "missing" in as_markdown(table)
    assert "from the same starts" in as_markdown(table)
    line = next(r for r in csv.DictReader(io.StringIO(as_csv(table))) if r["method"] == "none")
    assert line["mean_m"] == line["ratio"] == ""
    assert line["missing"] == "0 1 2"
    text_table(table).rich()  # its columns agree


def test_a_cell_without_deployment_counts_in_the_surrogate_only():
    half = cell("left", "gradient", 0, ([9.0], [3.0], [True]), None)
    rows = make_table(wanted_of([half]), [half]).rows
    assert [row.ratio for row in rows] == [3.0, None]
    assert rows[1].transfer is None


def test_targets_are_met_missed_or_not_measured(table):
    found = {(t.method, t.domain): t for t in table_targets(table)}
    # A seed of each is missing: a value, and no verdict.
    assert {t.met for t in found.values()} == {None}
    assert found["gradient", "surrogate"].value == 4.0
    assert found["gradient", "surrogate"].verdict == "2 seed(s) so far"
    whole = make_table(wanted_of(table.cells.values()), table.cells.values())
    found = {(t.method, t.domain): t for t in table_targets(whole)}
    assert found["gradient", "surrogate"].met
    assert found["gradient", "deployed"].met
    random = found["random", "deployed"]
    assert (random.value, random.met) == (1.4, False)
    assert random.verdict == "missed by 17 %"
    empty = {t.verdict for t in table_targets(make_table(WANTED, []))}
    assert empty == {"not measured"}


def test_the_live_scenarios_have_targets_of_their_own():
    cells = [
        cell("monitor", "gradient", seed, ([9.0], [2.0], [True]), ([8.0], [2.0], [seed < 4]))
        for seed in range(5)
    ] + [
        cell("green_screen", "gradient", seed, ([9.0], [2.0], [True]), ([5.0 + 10 * seed], [1.0], [True]))
        for seed in (0, 1)
    ]
    cells.append(cell("green_screen", "random", 0, ([2.0], [2.0], [False]), ([2.0], [2.0], [True])))
    found = {(t.scenario, t.method, t.what): t for t in table_targets(make_table(wanted_of(cells), cells))}
    assert found["monitor", "gradient", "share of drives off the track"].met
    spread = found["green_screen", "gradient", "std / mean"]
    assert spread.value == pytest.approx(50**0.5 / 10.0)
    assert spread.met is False
    assert found["green_screen", "random", "drives off the track"].met is False


def test_json_and_page_hold_the_same_numbers(table):
    data = json.loads(json.dumps(as_json(table), allow_nan=False))
    assert len(data["rows"]) == 6
    assert data["targets"][0]["value"] == 4.0
    assert set(data["cells"]) == set(table.cells)
    page = render_transfer_page(table)
    assert "4.00" in page
    assert "missing" in page
    assert "http" not in page.replace("http-equiv", "")


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
    assert {clip.file for clip in shown} == {
        "videos/strayed/straight_hardened_gradient_0.mp4",
        "videos/left_the_track/left_hardened_gradient_0.mp4",
    }
    assert all((tmp_path / "page" / clip.file).is_file() for clip in shown)


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


def test_the_skill_of_predictions_by_hand():
    pairs = [
        Predicted("a", "gradient", 8.0, 7.0, 9.0, 4.0, 1.0, 8.0, 4.0, 12.0, 12.0),
        Predicted("b", "random", 1.0, 0.9, 1.1, 1.0, 1.0, 2.0, 2.0, 1.6, 2.0),
        Predicted("c", "cem", 3.0, 2.0, 4.0, 1.2, 1.0, 3.0, 3.0, 1.2, 3.0),
    ]
    skill = skill_of(pairs)
    assert (skill.count, skill.right) == (3, 2)
    assert skill.factor == pytest.approx(2.0)  # factors 2, 1, 2.5
    assert skill.factor_total == pytest.approx(1.0)
    assert skill.rank_correlation == pytest.approx(1.0)
    # What the search's own drives in the surrogate say: factors 3, 1.6, 1; ranks 3, 2, 1 of 3, 1, 2.
    plain = skill_of([pair.unpredicted for pair in pairs])
    assert plain.factor == pytest.approx(1.6)
    assert plain.rank_correlation == pytest.approx(0.5)
    assert plain.right == 2
    assert "2 of 3 rightly said" in prediction_section(pairs)
    assert "would be off by 1.60 and 1.00, rank correlation 0.50, 2 of 3 right" in prediction_section(pairs)
    assert "No attack was both" in prediction_section([])


@pytest.mark.parametrize(
    ("limit", "says"),
    [
        ({"method": "gradient"}, "one of at_least, at_most and above, got 0"),
        ({"method": "gradient", "at_least": 1, "above": "random"}, "got 2"),
        ({"method": "gradient", "at_least": 1, "of": "luck"}, "of"),
    ],
)
def test_a_limit_that_says_nothing_or_two_things_is_refused(limit, says):
    with pytest.raises(ValueError, match=says):
        Reference.model_validate({"targets": {"straight": [limit]}})


def test_without_a_reference_there_is_neither_paper_nor_target(table):
    bare = table_of(WANTED, table.cells.values())
    assert table_targets(bare) == []
    assert {row.paper_m for row in bare.rows} == {None}
    assert "Targets" not in render_transfer_page(bare)
