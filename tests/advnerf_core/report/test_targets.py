from dataclasses import replace

import numpy as np
import pytest

from advnerf_core.report.data import Fidelity, FidelityView, Laps, Latency, MemoryRow
from advnerf_core.report.reference import LiveLimit
from advnerf_core.report.summary import key_figures, opening, verdict
from advnerf_core.report.targets import evaluate_targets


def verdicts(report):
    return {t.what: t.met for t in evaluate_targets(report)}


def test_nothing_measured_is_neither_met_nor_missed(bare_report):
    report = replace(bare_report, manifest=replace(bare_report.manifest, wall_s=None))
    assert set(verdicts(report).values()) == {None}
    assert verdict(evaluate_targets(report)) == "No target was measured in this run."
    assert all(k.met is None for k in key_figures(report))


@pytest.mark.parametrize(("ratio", "met"), [(3.29, False), (3.3, True)])
def test_surrogate_ratio(bare_report, make, ratio, met):
    clean = replace(make.drive("surrogate", "none", 0.0), total_cte_m=1.0)
    attacked = replace(make.drive("surrogate", "gradient", 0.0), total_cte_m=ratio)
    assert (
        verdicts(replace(bare_report, runs=(clean, attacked)))["gradient attack, surrogate: total CTE"] is met
    )


@pytest.mark.parametrize(("off_track", "met"), [((True, True, False), True), ((True, False, False), False)])
def test_leaving_the_track_in_two_of_three(bare_report, make, off_track, met):
    runs = tuple(
        replace(make.drive("deployed", "gradient", 0.0, s), off_track=o) for s, o in enumerate(off_track)
    )
    name = "gradient attack, live: left the track"
    assert verdicts(replace(bare_report, runs=runs))[name] is met


@pytest.mark.parametrize(("ratio", "left"), [(1.4, False), (1.6, False), (1.4, True)])
def test_random_may_neither_be_strong_nor_leave(bare_report, make, ratio, left):
    clean = replace(make.drive("deployed", "none", 0.0), total_cte_m=1.0)
    random = replace(make.drive("deployed", "random", 0.0), total_cte_m=ratio, off_track=left)
    found = verdicts(replace(bare_report, runs=(clean, random)))
    assert found["best random texture, live: total CTE"] is (ratio <= 1.5)
    assert found["best random texture, live: left the track"] is (not left)


@pytest.mark.parametrize(
    ("samples", "missed", "fast", "none_missed"),
    [
        ((20.0, 30.0), 0, True, True),
        ((20.0, 130.0), 0, False, True),
        ((20.0,), 1, True, False),
        ((20.0,), None, True, None),
    ],
)
def test_latency(bare_report, samples, missed, fast, none_missed):
    found = verdicts(replace(bare_report, latency=Latency(np.array(samples), 100.0, missed)))
    assert found["capture to serial write, live, p99"] is fast
    assert found["control ticks missed, live"] is none_missed


def test_memory_needs_both_horizons(bare_report):
    name = "adjoint, peak memory above idle, T = 400 against T = 50"
    assert verdicts(replace(bare_report, memory=(MemoryRow(50, 100.0), MemoryRow(200, 90.0))))[name] is None
    assert verdicts(replace(bare_report, memory=(MemoryRow(50, 100.0), MemoryRow(400, 110.0))))[name] is True
    assert verdicts(replace(bare_report, memory=(MemoryRow(50, 100.0), MemoryRow(400, 111.0))))[name] is False


def test_fidelity_and_laps(bare_report):
    views = (
        FidelityView("a", 26.0, 30.0, None, None, 0.1, 0.139),
        FidelityView("b", 27.0, 24.5, None, None, 0.1, 0.08),
    )
    laps = Laps(3, np.zeros((4, 3)), np.zeros(4), 0.079, False)
    found = verdicts(replace(bare_report, fidelity=Fidelity(views), laps=laps))
    assert found["surrogate on held-out views, full size: PSNR"] is False  # 26.5 dB
    assert found["surrogate on held-out views, 200x66: PSNR"] is True  # 27.25 dB
    assert found["steering on surrogate against real views: mean difference"] is True  # 0.0295 rad
    assert found["policy without attack, live: mean |CTE|"] is True
    assert found["policy without attack, live: left the track"] is True
    assert found["policy without attack, live: laps"] is True


def test_cached_stages_do_not_count_as_a_fresh_run(report):
    name = "full setting, 2 cores"
    report = replace(report, manifest=replace(report.manifest, wall_s=1500.0))
    assert verdicts(report)[name] is True
    stages = (replace(report.timings[0], cached=True), *report.timings[1:])
    assert verdicts(replace(report, timings=stages))[name] is None


def test_the_opening_names_every_miss(bare_report):
    views = (FidelityView("fox photographs", 24.1, 24.1, None, None, 0.0, 0.0),)
    limit = LiveLimit(what="fox photographs", of="psnr_full_db", at_least=26)
    text = " ".join(opening(replace(bare_report, fidelity=Fidelity(views), limits=(limit,))))
    assert "Missed:" in text
    assert "fox photographs: 24.1 dB (target ≥ 26 dB)" in text
    assert "small setting" in text


def test_a_limit_has_one_bound_and_drives_a_method():
    with pytest.raises(ValueError, match="one of at_least and at_most"):
        LiveLimit(what="x", of="laps", at_least=1, at_most=2)
    for of, method in (("ratio", ""), ("laps", "gradient")):
        with pytest.raises(ValueError, match="expected a method with ratio"):
            LiveLimit(what="x", of=of, method=method, at_least=1)


def test_a_report_without_limits_says_nothing_of_targets(bare_report):
    free = replace(bare_report, limits=())
    assert evaluate_targets(free) == ()
    assert verdict(()) == ""
    assert key_figures(free) == ()
