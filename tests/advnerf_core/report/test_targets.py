from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from advnerf_core.report.data import Fidelity, FidelityView, Laps, Latency
from advnerf_core.report.reference import Limit, Reference
from advnerf_core.report.result_table import ResultTable
from advnerf_core.report.targets import evaluate, verdict

FILE = Path(__file__).parents[3] / "launch" / "room.reference.yaml"
LIMITS = Reference.model_validate(yaml.safe_load(FILE.read_text())).targets
NO_ROWS = ResultTable(())


def verdicts(report, table=NO_ROWS):
    return {t.what: t.met for t in evaluate(LIMITS, table, report.measured)}


def test_nothing_measured_is_neither_met_nor_missed(bare_report, make):
    targets = evaluate(LIMITS, make.table([]), bare_report.measured)
    assert {target.met for target in targets} == {None}
    assert len(targets) == len(LIMITS)
    assert verdict(targets) == "No target was measured in this run."


@pytest.mark.parametrize(("ratio", "met"), [(3.29, False), (3.3, True)])
def test_surrogate_ratio(bare_report, make, ratio, met):
    table = make.table([("surrogate", "none", [1.0], [False]), ("surrogate", "gradient", [ratio], [False])])
    assert verdicts(bare_report, table)["gradient attack, surrogate: total CTE"] is met


@pytest.mark.parametrize(("off_track", "met"), [([True, True, False], True), ([True, False, False], False)])
def test_leaving_the_track_in_two_of_three(bare_report, make, off_track, met):
    table = make.table([("deployed", "gradient", [5.0] * 3, off_track)])
    assert verdicts(bare_report, table)["gradient attack, live: left the track"] is met


def test_a_car_that_ran_into_something_is_not_told_as_one_that_merely_stayed(make):
    drives = [("deployed", "none", [1.0] * 3, [False] * 3), ("deployed", "gradient", [5.0] * 3, [False] * 3)]
    blocked = {"extra": {"horizon": 60, "blocked_tick": [None, 44, 45]}}
    limit = Limit(method="gradient", of="off_track_share", at_least=0.6)
    free, hit = (evaluate([limit], make.table(drives, **extra))[0] for extra in ({}, blocked))
    assert free.measured == "0 of 3 drives"
    assert hit.measured == "0 of 3 drives, collided: 2 (2 obstacle)"
    assert free.met is hit.met is False


@pytest.mark.parametrize(("ratio", "left"), [(1.4, False), (1.6, False), (1.4, True)])
def test_random_may_neither_be_strong_nor_leave(bare_report, make, ratio, left):
    table = make.table([("deployed", "random", [ratio], [left])])
    found = verdicts(bare_report, table)
    assert found["best random texture, live: total CTE"] is (ratio <= 1.5)
    assert found["best random texture, live: left the track"] is (not left)


@pytest.mark.parametrize(
    ("samples", "missed", "fast", "none_missed"),
    [
        ((20.0, 30.0), 0, True, True),
        ((20.0, 130.0), 0, False, True),
        ((20.0,), 1, True, False),
    ],
)
def test_latency(bare_report, samples, missed, fast, none_missed):
    found = verdicts(replace(bare_report, latency=Latency(np.array(samples), 100.0, missed, {})))
    assert found["capture to serial write, live, p99"] is fast
    assert found["control ticks missed, live"] is none_missed


def test_fidelity_and_laps(bare_report):
    views = (
        FidelityView("a", 26.0, 30.0, 0.9, 0.9, 0.1, 0.139),
        FidelityView("b", 27.0, 24.5, 0.9, 0.9, 0.1, 0.08),
    )
    laps = Laps(3, np.zeros((4, 3)), np.zeros(4), 0.079, False)
    found = verdicts(replace(bare_report, fidelity=Fidelity(views), laps=laps))
    assert found["surrogate on held-out views, full size: PSNR"] is False  # 26.5 dB
    assert found["surrogate on held-out views, 200x66: PSNR"] is True  # 27.25 dB
    assert found["steering on surrogate against real views: mean difference"] is True  # 0.0295 rad
    assert found["policy without attack, live: mean |CTE|"] is True
    assert found["policy without attack, live: left the track"] is True
    assert found["policy without attack, live: laps"] is True


def test_the_verdict_names_every_miss(bare_report):
    views = (FidelityView("fox photographs", 24.1, 24.1, 0.9, 0.9, 0.0, 0.0),)
    limit = Limit(what="fox photographs", of="psnr_full_db", at_least=26)
    measured = replace(bare_report, fidelity=Fidelity(views)).measured
    text = verdict(evaluate([limit], NO_ROWS, measured))
    assert text == "0 of 1 measured target was met. Missed: fox photographs: 24.1 dB (target ≥ 26 dB)."
    assert verdict(()) == ""


def test_limits_on_what_a_table_has_not_are_left_out():
    assert evaluate(LIMITS, NO_ROWS) == []
