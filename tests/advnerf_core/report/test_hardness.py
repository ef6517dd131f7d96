"""A victim is hardened if it withstands the worst texture of N, judged before its gradient runs; pages call any other by what it was trained with."""

import json

import numpy as np
import pytest
from scipy import stats

from advnerf_core.report.cells import cell_from
from advnerf_core.report.evidence.hardness import (
    HARDENED,
    PUBLISHED_FILE,
    TRAINED_WITH_TEXTURES,
    FamilyHardness,
    HardnessError,
    HardnessRecord,
    HardnessVerdict,
    merged,
    read_hardness,
    victim_title,
    with_titles,
    write_hardness,
)

POLICY = "a" * 64


def verdict(excess_m, policy=POLICY, steps=250, **changes):
    values = np.asarray(excess_m, float)
    found = FamilyHardness.of("track", "random_natural", values)
    fields = {
        "victim": "hardened", "policy_sha256": policy, "recipe": {"steps": steps}, "trained_on": ("random",),
        "validated_on": ("random_natural",), "textures": len(values), "seed": 20_000, "starts": values.shape[1],
        "margin_m": 0.04, "families": (found,),
    }  # fmt: skip
    return HardnessVerdict(**{**fields, **changes})


def cell(digest, method="gradient", policy=POLICY):
    drives = {"total_cte_m": [1.0], "off_track": [False], "none_total_cte_m": [1.0]}
    return cell_from(
        {
            "scenario": "track", "victim": "hardened", "method": method, "seed": 0, "settings_hash": "", "seconds": 1.0, "machine": "", "date": "",
            "surrogate": drives, "policy_sha256": policy, "extra": {"hardness": digest},
        },
        "a cell",
    )  # fmt: skip


def test_one_texture_of_fifty_that_moves_the_car_is_enough():
    excess = np.full((50, 6), 0.001)
    excess[17] = 0.05 + 0.002 * np.arange(6)
    found = FamilyHardness.of("track", "random_coarse", excess)
    assert np.mean(found.excess_m) < 0.003  # in the mean over textures there is nothing to be seen
    assert found.worst_m == pytest.approx(0.055)
    error = np.std(excess[17], ddof=1) / np.sqrt(6)
    assert found.upper_m == pytest.approx(stats.t(5, 0.055, error).ppf(0.95))
    assert not verdict(excess).passed
    assert verdict(np.delete(excess, 17, axis=0)).passed


def test_the_bound_covers_the_worst_texture_in_95_of_100_draws_of_starts():
    rng = np.random.default_rng(3)
    # One texture is far worse than the others, so that the same one is judged in each draw.
    draws = [FamilyHardness.of("", "", [rng.normal(0.3, 0.1, 5), np.zeros(5)]).upper_m for _ in range(4000)]
    assert np.mean(np.array(draws) >= 0.3) == pytest.approx(0.95, abs=0.012)


def test_near_the_margin_starts_that_differ_do_not_pass_and_one_start_never_does():
    assert verdict([[0.035, 0.035, 0.0351]]).passed
    assert not verdict([[0.0, 0.0, 0.105]]).passed
    assert not verdict([[0.0]]).passed


def test_families_that_train_do_not_validate():
    with pytest.raises(
        ValueError, match="expected other families to validate than to train, got random_natural"
    ):
        verdict([[0.0, 0.0]], trained_on=("random_natural",))
    with pytest.raises(ValueError, match="results of random_pink and no others"):
        verdict([[0.0, 0.0]], validated_on=("random_pink",))


def test_a_policy_has_one_verdict_and_a_victim_three_recipes():
    record = HardnessRecord()
    for number in range(3):
        record = record.with_verdict(verdict([[0.1, 0.1]], policy=str(number), steps=number))
    assert record.with_verdict(verdict([[0.1, 0.1]], policy="2", steps=2)) == record
    with pytest.raises(HardnessError, match="at most 3 recipes of one victim, got 4"):
        record.with_verdict(verdict([[0.0, 0.0]], policy="3", steps=3))
    with pytest.raises(HardnessError, match="a victim is not judged until it passes"):
        record.with_verdict(verdict([[0.0, 0.0]], policy="2", steps=2))
    # All are published, also those that did not pass.
    assert merged([record, record]).verdicts == record.verdicts


def test_a_title_is_earned_by_a_verdict_that_every_gradient_search_has_seen():
    passed, failed = verdict([[0.001, 0.002]]), verdict([[0.1, 0.1]])
    record = HardnessRecord(verdicts=(passed,))
    seen, unseen = cell(passed.digest), cell("")
    assert victim_title(HARDENED, [seen], record) == HARDENED
    assert victim_title(HARDENED, [seen, cell("", "random_pink")], record) == HARDENED
    for cells, known in (
        ([seen], HardnessRecord()),
        ([seen, unseen], record),
        ([cell(passed.digest, policy="b")], record),
        ([], record),
        ([cell(failed.digest)], HardnessRecord(verdicts=(failed,))),
    ):
        assert victim_title(HARDENED, cells, known) == TRAINED_WITH_TEXTURES
    # A victim that was chosen on a baseline's own textures is no test of that baseline.
    assert victim_title(HARDENED, [seen], record, ("random_natural", "cem")) == TRAINED_WITH_TEXTURES
    assert victim_title(HARDENED, [seen], record, ("random_pink", "cem")) == HARDENED
    assert victim_title("naive", [], record) == "naive"


def test_titles_are_read_from_the_folder_of_a_set(tmp_path):
    passed, row = verdict([[0.001, 0.002]]), {"victim": "hardened"}
    data = {
        "rows": [row],
        "primary": [{"test": {"victim": "hardened", "against": ["cem"]}}],
        "contrasts": [row],
    }
    (tmp_path / "a_cell.json").write_text(
        json.dumps(cell(passed.digest).model_dump(mode="json", exclude_unset=True))
    )
    assert with_titles(tmp_path, data)["rows"] == [{"victim": TRAINED_WITH_TEXTURES}]
    write_hardness(tmp_path / PUBLISHED_FILE, HardnessRecord(verdicts=(passed,)))
    assert read_hardness(tmp_path / PUBLISHED_FILE).passing(POLICY) == passed
    found = with_titles(tmp_path, data)
    assert {
        found["rows"][0]["victim"],
        found["primary"][0]["test"]["victim"],
        found["contrasts"][0]["victim"],
    } == {HARDENED}
    (tmp_path / PUBLISHED_FILE).write_text('{"format": "another"}')
    with pytest.raises(HardnessError, match="judge the victim again"):
        read_hardness(tmp_path / PUBLISHED_FILE)
