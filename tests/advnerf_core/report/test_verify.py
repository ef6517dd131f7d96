"""A published set is verified from its files alone; what was changed in it is found."""

import json
import random
import shutil
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.registration import (
    FILE,
    WITHDRAWN,
    Registration,
    RegistrationError,
    read_registration,
    withdraw,
)
from advnerf_core.report.evidence.results import Evidence, primary_tests, rows
from advnerf_core.report.evidence.verify import DIGESTS, PAGE, SET, SetError, sets_in, verify_set, write_set
from benchmarks.planted_changes import CHANGES, write_simulated_set
from nodes.cli.main import app


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    return folder


@pytest.fixture
def copied(original, tmp_path):
    shutil.copytree(original, tmp_path / "simulated")
    for beside in (DIGESTS, PAGE, "simulated_excess.png"):
        shutil.copy(original.parent / beside, tmp_path / beside)
    return tmp_path / "simulated"


def evidence_of(folder):
    return Evidence(read_registration(folder), read_cells(folder))


def test_a_set_as_it_was_published_has_no_problem(original):
    found = verify_set(original)
    assert found.problems == ()
    assert found.drives == 13 * 2 * 5  # none and two methods of six searches, two domains, five starts
    assert found.numbers > 50


def test_a_cell_that_was_not_driven_live_is_refused_as_evidence(copied):
    file = next(copied.glob("*_gradient_0.json"))
    data = json.loads(file.read_text())
    data["not_driven_live"] = "live0 was spoiled 3 times"
    del data["deployed"], data["kept"]["deployed"]
    file.write_text(json.dumps(data))
    assert file.stem not in evidence_of(copied).cells
    with pytest.raises(SetError, match="was not driven live and is no evidence: live0 was spoiled 3 times"):
        write_set(copied)
    assert any("was not driven live and is no evidence" in text for text in verify_set(copied).problems)


def test_a_cell_cannot_be_driven_live_and_not(copied):
    file = next(copied.glob("*_gradient_0.json"))
    file.write_text(json.dumps({**json.loads(file.read_text()), "not_driven_live": "late"}))
    assert "expected no deployed drives in a cell that was not driven live" in verify_set(copied).problems[0]


@pytest.mark.parametrize("kind", CHANGES)
@pytest.mark.parametrize("seed", range(3))
def test_every_kind_of_change_is_found(copied, kind, seed):
    CHANGES[kind](copied, random.Random(seed))
    assert verify_set(copied).problems


def test_a_missing_cell_and_a_strange_file_are_named(copied):
    (copied / "track_hardened_gradient_3.json").unlink()
    (copied / "track_hardened_gradient_4.json").rename(copied / "track_hardened_other_4.json")
    problems = "\n".join(verify_set(copied).problems)
    assert "track_hardened_gradient_3: was registered, and is not there" in problems
    assert "track_hardened_other_4.json: is not listed" in problems


def test_rows_are_metres_per_tick_over_the_same_starts(original):
    evidence = evidence_of(original)
    (row,) = [each for each in rows(evidence) if (each.method, each.domain) == ("gradient", "deployed")]
    totals = [
        (cell.deployed.total_cte_m, cell.deployed.none_total_cte_m)
        for cell in read_cells(original)
        if cell.method == "gradient"
    ]
    expected = np.mean([np.subtract(attacked, none) / 60 for attacked, none in totals])
    assert row.excess_m == pytest.approx(expected, abs=1e-5)
    assert row.low_m < row.excess_m < row.high_m
    assert row.registered
    (none,) = [each for each in rows(evidence) if (each.method, each.domain) == ("none", "deployed")]
    assert none.excess_m == pytest.approx(np.mean(totals[0][1]) / 60, abs=1e-5)


def test_the_primary_test_is_that_of_scipy(original):
    evidence = evidence_of(original)
    (found,) = primary_tests(evidence)
    ours, theirs = (
        [
            np.mean([outcome.excess_cte_m_per_tick for outcome in evidence.outcomes(cell, "deployed")])
            for cell in evidence.searches(("track", "", "hardened", method))
        ]
        for method in ("gradient", "random")
    )
    expected = stats.permutation_test(
        (ours, theirs), lambda a, b, axis: a.mean(axis) - b.mean(axis), alternative="greater", vectorized=True
    )
    assert found.p == pytest.approx(expected.pvalue)
    assert found.p_holm == found.p == pytest.approx(1 / 924)
    assert found.baseline == "random"
    assert len(found.mcnemar) == 6
    # Where they search, it is the same test, and each search is kept in both domains.
    searches = [found.searches[method] for method in ("gradient", "random")]
    here, there = (
        tuple([getattr(search, name) for search in each] for each in searches)
        for name in ("surrogate_m", "deployed_m")
    )
    assert there == (ours, theirs)
    assert found.difference_surrogate_m == pytest.approx(np.mean(here[0]) - np.mean(here[1]))
    expected = stats.permutation_test(
        here, lambda a, b, axis: a.mean(axis) - b.mean(axis), alternative="greater", vectorized=True
    )
    assert found.p_surrogate == pytest.approx(expected.pvalue)
    cell, path = (
        evidence.cells["track_hardened_gradient_2"],
        evidence.registration.scenarios["track"].reference_path(),
    )
    ctes = [
        np.mean([path.project(drive.poses()[1:, :2]).cte_m.mean() for drive in each.kept["surrogate"]])
        for each in (cell, evidence.without(cell))
    ]
    assert searches[0][2].shift_m == pytest.approx(ctes[0] - ctes[1], abs=1e-9)
    assert (found.anytime.pairs, found.anytime.of_pairs) == (4, 6)


def test_the_page_says_it_in_two_sentences_and_a_changed_page_is_found(copied):
    page = copied.parent / PAGE
    text = page.read_text()
    assert "of 30 drives leave the track" in text
    assert "p = 0.0011 after Holm's adjustment" in text
    assert (copied.parent / "simulated_excess.png").stat().st_size > 10_000
    page.write_text(text.replace("of 30 drives", "of 29 drives"))
    assert verify_set(copied).problems == (f"{page}: is not the page of the published sets",)


def test_what_was_not_registered_is_exploration(copied):
    extra = json.loads((copied / "track_hardened_gradient_0.json").read_text())
    extra |= {"method": "cem", "registration": ""}
    (copied / "track_hardened_cem_0.json").write_text(json.dumps(extra))
    write_set(copied)
    assert verify_set(copied).problems == ()
    last = rows(evidence_of(copied))[-1]
    assert (last.method, last.registered) == ("cem", False)


def test_a_set_that_contradicts_its_registration_is_not_written(copied):
    file = copied / "track_hardened_random_2.json"
    data = json.loads(file.read_text())
    data["kept"]["deployed"] = data["kept"]["deployed"][:-1]
    file.write_text(json.dumps(data))
    with pytest.raises(SetError, match="expected drives from 5 registered starts, got 4"):
        write_set(copied)


def test_a_folder_without_registration_is_no_set(tmp_path, copied):
    with pytest.raises(SetError, match="advnerf register"):
        write_set(tmp_path)
    (copied / FILE).write_text("{}")
    with pytest.raises(RegistrationError, match="restore it from git"):
        read_registration(copied)
    assert "restore it from git" in verify_set(copied).problems[0]


def test_the_command_verifies_all_sets_and_fails_where_one_is_wrong(copied):
    def call(*arguments):
        return CliRunner().invoke(app, ["verify", "--in", str(copied.parent), *arguments])

    assert sets_in(copied.parent) == ["simulated"]
    done = call()
    assert done.exit_code == 0
    assert "all as published" in done.output
    (copied / SET).write_text((copied / SET).read_text().replace("gradient", "gradients", 1))
    assert call("simulated").exit_code == 1
    assert "expected a set of simulated" in str(call("other").exception)


def test_what_is_only_registered_awaits_its_results_and_what_vanished_does_not(copied):
    for file in (*copied.glob("*.json"), copied / SET):
        file.unlink()
    assert "cannot be read" in verify_set(copied).problems[0]
    (copied.parent / DIGESTS).write_text("{}")
    found = verify_set(copied)
    assert found.problems == ()
    assert found.awaits_results
    done = CliRunner().invoke(app, ["verify", "--in", str(copied.parent)])
    assert done.exit_code == 0
    assert "registered, nothing published yet" in done.output


def test_too_few_searches_for_any_test_leave_the_interval(copied):
    whole = evidence_of(copied)
    few = {name: cell for name, cell in whole.cells.items() if cell.seed < 5}
    (test,) = primary_tests(Evidence(whole.registration, list(few.values())))
    assert test.p is None
    assert test.p_holm is None
    assert test.low_m <= test.difference_m <= test.high_m


def test_verifying_needs_no_torch(original):
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from pathlib import Path; from advnerf_core.report.evidence.verify import verify_set\n"
        f"assert verify_set(Path({str(original)!r})).problems == ()"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.fixture
def half_run(copied):
    """The simulated set, with a second scenario registered of which nothing was run."""
    registration = read_registration(copied)
    data = registration.model_dump(mode="json")
    data["scenarios"]["other"] = data["scenarios"]["track"]
    for part in ("cells", "primary"):
        data[part] += [{**each, "scenario": "other"} for each in data[part]]
    other = Registration.model_validate(data)
    (copied / FILE).write_text(other.model_dump_json(indent=1))
    for file in copied.glob("*.json"):
        cell = json.loads(file.read_text())
        file.write_text(json.dumps({**cell, "registration": other.digest}))
    return copied


def test_a_scenario_that_was_given_up_is_told_with_its_reason_and_counts_against_the_others(
    half_run, original
):
    with pytest.raises(SetError, match="other_hardened_none_0: was registered, and is not there"):
        write_set(half_run)
    withdraw(half_run, {"other": "It would have taken two days."})
    write_set(half_run)
    assert verify_set(half_run).problems == ()
    page = (half_run.parent / PAGE).read_text()
    assert "**Registered, and not run:** other, with 13 cells and 1 of the primary tests" in page
    assert "It would have taken two days." in page
    (alone,), (beside,) = (primary_tests(evidence_of(folder)) for folder in (original, half_run))
    assert beside.p == alone.p
    assert beside.p_holm == pytest.approx(min(1.0, 2.0 * alone.p))
    # The reason cannot be changed or dropped unnoticed.
    (half_run / WITHDRAWN).write_text(json.dumps({"other": "No matter."}))
    assert any(WITHDRAWN in each for each in verify_set(half_run).problems)
    (half_run / WITHDRAWN).unlink()
    assert any("is not there" in each for each in verify_set(half_run).problems)


@pytest.mark.parametrize(
    ("scenarios", "says"),
    [
        ({"third": "why not"}, "expected a registered scenario to withdraw (other, track), got 'third'"),
        ({"other": " "}, "expected a reason for withdrawing other"),
        (
            {"track": "It did not come out well."},
            "track cannot be withdrawn, as track_hardened_",
        ),
    ],
)
def test_results_and_strangers_cannot_be_withdrawn(half_run, scenarios, says):
    with pytest.raises(RegistrationError) as error:
        withdraw(half_run, scenarios)
    assert says in str(error.value)
    assert not (half_run / WITHDRAWN).exists()
