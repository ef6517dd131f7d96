"""A published set is verified from its files alone; what was changed in it is found."""

import json
import random
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats
from typer.testing import CliRunner

from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.kept_build import is_kept
from advnerf_core.report.evidence.publishing import write_page
from advnerf_core.report.evidence.registration import (
    FILE,
    WITHDRAWN,
    SetError,
    read_registration,
    registered_file,
    require_registered,
    withdraw,
)
from advnerf_core.report.evidence.results import Evidence, primary_tests, read_evidence, rows
from advnerf_core.report.evidence.verify import verify_beside, verify_set
from advnerf_core.report.evidence.verifying.digests import write_beside
from advnerf_core.report.evidence.verifying.drives import drive_problems
from advnerf_core.report.evidence.verifying.layout import BESIDE, DIGESTS, PAGE, SET, sets_in
from advnerf_core.report.evidence.verifying.pictures import picture_problems
from advnerf_core.report.evidence.verifying.victims import DECLARED, declare
from benchmarks.planting.simulated import write_simulated_set
from benchmarks.planting.world import World, poses_of
from nodes.cli.main import app
from nodes.cli.verify import _ledger
from tests.support.published import write_set


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    return folder


@pytest.fixture
def copied(original, tmp_path):
    return shutil.copytree(original.parent, tmp_path / "docs" / "results") / "simulated"


def evidence_of(folder):
    return read_evidence(folder)


def test_a_set_as_it_was_published_has_no_problem(original):
    found = verify_set(original)
    assert found.problems == ()
    # Two conditions, none and two methods of six searches, two domains, five starts.
    assert found.drives == 2 * 13 * 2 * 5
    assert verify_beside(original.parent) == ()
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


def test_a_missing_cell_and_a_strange_file_are_named(copied):
    (copied / "track_hardened_gradient_3.json").unlink()
    (copied / "track_hardened_gradient_4.json").rename(copied / "track_hardened_other_4.json")
    problems = "\n".join(verify_set(copied).problems)
    assert "track_hardened_gradient_3: was registered, and is not there" in problems
    assert "track_hardened_other_4.json: is not listed" in problems


def test_a_file_is_of_the_cell_that_it_is_named_after(copied):
    """Of two files of one cell the last one counted, and files that were exchanged were taken."""
    first, second = copied / "track_hardened_gradient_0.json", copied / "track_hardened_gradient_1.json"
    copy = shutil.copy(first, copied / "track_hardened_gradient_0 (copy).json")
    with pytest.raises(
        SetError, match=r"\(copy\)\.json: expected the cell of this name, got track_hardened_gradient_0"
    ):
        write_set(copied)
    copy.unlink()
    texts = first.read_text(), second.read_text()
    first.write_text(texts[1])
    second.write_text(texts[0])
    problems = verify_set(copied).problems
    for file, other in ((first, second), (second, first)):
        assert any(
            text.startswith(f"{file}: expected the cell of this name, got {other.stem}") for text in problems
        )


def no_poses(data):
    data["kept"]["deployed"][0].update(x_m="", y_m="", yaw_rad="")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda data: data["extra"].update(max_abs_cte_m=float("nan")), "expected a largest |CTE| of"),
        (lambda data: data["extra"].update(max_abs_cte_m="0.7"), "expected a largest |CTE| of"),
        (lambda data: data["extra"].update(blocked_tick=5), "whether its drives ended against something"),
        (no_poses, "expected 61 poses, got 0"),
    ],
)
def test_a_value_of_another_kind_is_a_problem_and_no_crash(copied, change, says):
    file = copied / "track_hardened_gradient_0.json"
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))
    assert any(says in problem for problem in verify_set(copied).problems)
    with pytest.raises(SetError, match="cannot be published"):
        write_set(copied)


@pytest.mark.parametrize("text", ["[]", "null", '{"simulated": 1}'])
def test_a_manifest_of_another_form_is_a_problem_and_no_crash(copied, text):
    for name in (BESIDE, DIGESTS):
        file = copied.parent / name
        before = file.read_text()
        file.write_text(text)
        assert f"{file}: expected a digest for each name" in verify_beside(copied.parent)[0]
        file.write_text(before)
    (copied / SET).write_text(
        json.dumps({**json.loads((copied / SET).read_text()), "files": json.loads(text)})
    )
    assert any("expected a digest for each name" in problem for problem in verify_set(copied).problems)


@pytest.mark.parametrize("place", ["/", "/tmp"])
def test_a_folder_that_cannot_lie_in_a_checkout_has_no_rows_to_check(place, capsys):
    assert _ledger(Path(place)) == 0
    assert "rows and pages not checked" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda segments: segments[:-1], "expected a closed path to end at its start"),
        (lambda segments: len(segments), "expected a path "),
    ],
)
def test_a_registered_path_that_is_none_is_said_and_ends_nothing(copied, change, says):
    data = json.loads((copied / FILE).read_text())
    path = next(iter(data["scenarios"].values()))["path"]
    path["segments"] = change(path["segments"])
    (copied / FILE).write_text(json.dumps(data))
    with pytest.raises(SetError, match=says):
        read_registration(copied)
    assert any(says in problem for problem in verify_set(copied).problems)


def test_rows_are_metres_per_tick_over_the_same_starts(original):
    evidence = evidence_of(original)
    shown = {(each.scenario, each.method, each.domain): each for each in rows(evidence)}
    row = shown["track", "gradient", "deployed"]
    totals = [
        (cell.deployed.total_cte_m, cell.deployed.none_total_cte_m)
        for cell in read_cells(original)
        if (cell.scenario, cell.method) == ("track", "gradient")
    ]
    expected = np.mean([np.subtract(attacked, none) / 60 for attacked, none in totals])
    assert row.excess_m == pytest.approx(expected, abs=1e-5)
    assert row.low_m < row.excess_m < row.high_m
    assert row.registered
    none = shown["track", "none", "deployed"]
    assert none.excess_m == pytest.approx(np.mean(totals[0][1]) / 60, abs=1e-5)


def test_the_primary_test_is_that_of_scipy(original):
    evidence = evidence_of(original)
    found, own = primary_tests(evidence)
    ours, theirs = (
        [
            np.mean([outcome.excess_cte_m_per_tick for outcome in evidence.outcomes(cell, "deployed")])
            for cell in evidence.searches(("track", "hardened", method))
        ]
        for method in ("gradient", "random")
    )
    expected = stats.permutation_test(
        (ours, theirs), lambda a, b, axis: a.mean(axis) - b.mean(axis), alternative="greater", vectorized=True
    )
    assert found.p == pytest.approx(expected.pvalue)
    assert found.p == own.p == pytest.approx(1 / 924)
    assert found.p_holm == pytest.approx(
        3 / 924
    )  # over three tests, one of which was given up and counts as 1
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
    assert "p = 0.0032 after Holm's adjustment" in text
    assert (copied.parent / "simulated_excess.png").stat().st_size > 10_000
    page.write_text(text.replace("of 30 drives", "of 29 drives"))
    assert verify_beside(copied.parent) == (f"{page}: is not the page of the published sets",)


def test_what_was_not_registered_is_exploration(copied):
    extra = json.loads((copied / "track_hardened_gradient_0.json").read_text())
    extra |= {"method": "cem", "registration": "", "attack_id": "c0ffee"}
    for domain, drives in extra["kept"].items():  # of a search of its own
        extra["kept"][domain] = [{**each, "x_m": each["x_m"] + "0"} for each in drives]
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
    with pytest.raises(SetError, match="advnerf experiment register"):
        write_set(tmp_path)
    (copied / FILE).write_text("{}")
    with pytest.raises(SetError, match="restore it from git"):
        read_registration(copied)
    assert "restore it from git" in verify_set(copied).problems[0]


def test_the_command_verifies_all_sets_and_fails_where_one_is_wrong(copied):
    def call(*arguments):
        return CliRunner().invoke(app, ["verify", "--folder", str(copied.parent), *arguments])

    assert sets_in(copied.parent) == ["simulated"]
    done = call()
    assert done.exit_code == 0
    assert "all as published" in done.output
    (copied / SET).write_text((copied / SET).read_text().replace("gradient", "gradients", 1))
    assert call("simulated").exit_code == 1
    assert "expected a set of simulated" in str(call("other").exception)


def test_a_damaged_registration_is_a_problem_of_its_set_and_the_others_are_still_verified(copied):
    damaged = copied.parent / "another"
    (damaged / FILE).parent.mkdir(parents=True)
    (damaged / FILE).write_text((copied / FILE).read_text()[:-20])
    (problem,) = verify_set(damaged).problems
    assert problem.startswith(f"{damaged / FILE}:")
    done = CliRunner().invoke(app, ["verify", "--folder", str(copied.parent)])
    assert done.exit_code == 1
    assert "another: 0 numbers from 0 drives: 1 problems" in done.output
    assert f"simulated: {verify_set(copied).numbers} numbers from 260 drives: all as published" in done.output


def test_what_is_only_registered_awaits_its_results_and_what_vanished_does_not(copied):
    for file in [*copied.glob("*.json"), copied / SET]:
        file.unlink()
    for part in ("predictions", "gate"):
        shutil.rmtree(copied / part)
    assert "cannot be read" in verify_set(copied).problems[0]
    (copied.parent / DIGESTS).write_text("{}")
    write_page(copied.parent)
    found = verify_set(copied)
    assert found.problems == ()
    assert found.awaits == 26
    done = CliRunner().invoke(app, ["verify", "--folder", str(copied.parent)])
    assert done.exit_code == 0
    assert "0 drives of a set under way, which awaits 26 registered cells" in done.output


def test_a_set_under_way_lacks_cells_and_those_that_are_there_must_be_right(copied):
    files = sorted(copied.glob("*_gradient_*.json"))
    files[0].unlink()
    (copied / "predictions" / files[0].name).unlink()
    assert f"{files[0].stem}: was registered, and is not there" in verify_set(copied).problems
    (copied / SET).unlink()
    assert verify_set(copied).problems  # it was published whole
    (copied.parent / DIGESTS).write_text("{}")
    found = verify_set(copied)
    assert (found.problems, found.awaits, found.numbers) == ((), 1, 0)
    data = json.loads(files[1].read_text())
    data["deployed"]["total_cte_m"][0] += 1.0
    files[1].write_text(json.dumps(data))
    assert files[1].stem in verify_set(copied).problems[0]


@pytest.mark.parametrize(
    ("machine", "apart_m", "wrong"),
    [(None, 0.001, False), (None, 0.01, True), ("another", 0.01, False), ("another", 0.1, True)],
)
def test_the_control_of_another_machine_may_differ_in_its_last_digits(copied, machine, apart_m, wrong):
    (copied / SET).unlink()
    (copied.parent / DIGESTS).write_text("{}")
    file = next(copied.glob("*_gradient_*.json"))
    data = json.loads(file.read_text())
    data["machine"] = machine or data["machine"]
    data["deployed"]["none_total_cte_m"][0] += apart_m
    file.write_text(json.dumps(data))
    found = [text for text in verify_set(copied).problems if "total CTE without attack" in text]
    assert (
        found
        == [
            f"{file.stem}, deployed, start 0: its total CTE without attack is not that of the control's poses"
        ]
        * wrong
    )


def test_a_set_with_all_its_cells_is_not_under_way(copied):
    (copied / SET).unlink()
    (copied.parent / DIGESTS).write_text("{}")
    found = verify_set(copied)
    assert found.awaits == 0
    assert "cannot be read" in found.problems[0]


def test_too_few_searches_for_any_test_leave_the_interval(copied):
    whole = evidence_of(copied)
    few = {name: cell for name, cell in whole.cells.items() if cell.seed < 5}
    test, _ = primary_tests(Evidence(whole.registration, list(few.values())))
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
    """The simulated set before one of its scenarios was given up, of which nothing was run."""
    (copied / WITHDRAWN).unlink()
    return copied


def test_a_scenario_that_was_given_up_is_told_with_its_reason_and_counts_against_the_others(half_run):
    with pytest.raises(SetError, match="later_hardened_none_0: was registered, and is not there"):
        write_set(half_run)
    withdraw(half_run, {"later": "It would have taken two days."})
    write_set(half_run)
    assert verify_set(half_run).problems == ()
    page = (half_run.parent / PAGE).read_text()
    assert "**Registered, and not run:** later, with 13 cells and 1 of the primary tests" in page
    assert "It would have taken two days." in page
    # What was not registered cannot be withdrawn by hand.
    (half_run / WITHDRAWN).write_text(json.dumps({"later": "It would have taken two days.", "other": "No."}))
    assert "other: was withdrawn, and was not registered" in verify_set(half_run).problems
    # The reason cannot be changed or dropped unnoticed.
    (half_run / WITHDRAWN).write_text(json.dumps({"later": "No matter."}))
    assert any(WITHDRAWN in each for each in verify_set(half_run).problems)
    (half_run / WITHDRAWN).unlink()
    assert any("is not there" in each for each in verify_set(half_run).problems)


@pytest.mark.parametrize(
    ("scenarios", "says"),
    [
        ({"third": "why not"}, "expected a registered scenario to withdraw (later, own, track), got 'third'"),
        ({"later": " "}, "expected a reason for withdrawing later"),
        (
            {"track": "It did not come out well."},
            "track cannot be withdrawn, as track_hardened_",
        ),
    ],
)
def test_results_and_strangers_cannot_be_withdrawn(half_run, scenarios, says):
    with pytest.raises(SetError) as error:
        withdraw(half_run, scenarios)
    assert says in str(error.value)
    assert not (half_run / WITHDRAWN).exists()


def test_a_scenario_with_a_finished_cell_cannot_be_withdrawn(half_run):
    with pytest.raises(SetError, match="later cannot be withdrawn, as later_hardened_none_0 is finished"):
        withdraw(half_run, {"later": "It did not come out well."}, ["later_hardened_none_0"])
    assert not (half_run / WITHDRAWN).exists()


def test_cells_of_another_registration_are_refused_before_they_are_copied(half_run):
    digest = read_registration(half_run).digest
    require_registered(half_run, {"later_hardened_none_0": digest, "not_registered_0": ""})
    with pytest.raises(
        SetError, match="got later_hardened_none_0 and 1 more run without it or under another"
    ):
        require_registered(half_run, {"later_hardened_none_0": "", "later_hardened_random_0": "d" * 64})


def weave(folder, amplitude_m):
    """Give the victim other drives without attack, that swing about those that it had; all cells tell their totals."""
    world = World(folder.parents[2], folder.name, random.Random(0))
    file = folder / "own_hardened_none_0.json"
    data = json.loads(file.read_text())
    for number in range(5):
        poses = poses_of(data, "deployed", number)
        swing = amplitude_m * np.sin(np.linspace(0.0, 4.0 * np.pi, len(poses)))
        poses[:, 0] -= np.sin(poses[:, 2]) * swing
        poses[:, 1] += np.cos(poses[:, 2]) * swing
        steps = np.diff(poses[:, :2], axis=0)
        poses[1:, 2] = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        world.set_drive(data, "deployed", number, poses)
    file.write_text(json.dumps(data))
    for each in folder.glob("own_*.json"):
        cell = json.loads(each.read_text())
        cell["deployed"]["none_total_cte_m"] = data["deployed"]["total_cte_m"]
        each.write_text(json.dumps(cell))


def test_a_victim_that_does_not_drive_well_is_published_only_if_that_is_declared(copied):
    folder = copied
    weave(folder, 0.2)
    with pytest.raises(SetError, match=r"own\.hardened: does not drive well: mean \|CTE\| 0\.1"):
        write_set(folder)
    with pytest.raises(SetError, match="expected a reason"):
        declare(folder, {"own.hardened": " "})
    declare(folder, {"own.hardened": "Its car swings by itself."})
    write_set(folder)
    found = verify_set(folder)
    assert found.problems == ()
    assert "own hardened does not drive well deployed" in found.findings[0]
    page = (folder.parent / PAGE).read_text()
    assert (
        "**Does not drive well:** past the plain object, the victim trained with textures has a mean abs. CTE of 0.1"
        in page
    )
    assert "Its car swings by itself." in page
    (folder / DECLARED).unlink()
    assert any("publish with --declare own.hardened=REASON" in each for each in verify_set(folder).problems)


def test_a_victim_that_was_not_registered_is_not_declared(copied):
    with pytest.raises(
        SetError, match=r"expected a registered victim \(track\.hardened, .*\) to declare, got 'own\.harden'"
    ):
        declare(copied, {"own.hardened": "Its car swings.", "own.harden": "Its car swings."})
    assert not (copied / DECLARED).exists()


def test_who_drives_well_is_not_declared_otherwise(copied):
    declare(copied, {"own.hardened": "To be safe."})
    with pytest.raises(SetError, match=r"own\.hardened: is declared not to drive well, and does"):
        write_set(copied)


def test_pictures_films_and_the_reference_build_are_those_of_their_manifest(copied):
    published = copied.parent
    for name in ("simulated_excess.png", "simulated_drives.webp", "reference/scene_0/weights.json"):
        file = published / name
        data = file.read_bytes()
        file.write_bytes(data + b" ")
        (problem,) = verify_beside(published)
        assert problem.startswith(f"{file}: its digest is not the one in {BESIDE}; restore it from git")
        file.write_bytes(data)
    (published / BESIDE).unlink()
    assert "advnerf experiment publish writes it" in verify_beside(published)[0]


def test_a_file_that_another_stage_stores_is_missed_though_the_manifest_was_written_anew(copied):
    published = copied.parent
    record = published / "reference/scene_0/stage.json"
    record.write_text(json.dumps({"digest": "", "files_in": {"views.bin": "scene_1"}}))
    stored = published / "reference/scene_1/views.bin"
    stored.parent.mkdir()
    stored.write_bytes(b"views")
    write_beside(published)
    assert verify_beside(published) == ()
    stored.unlink()
    write_beside(published)
    assert verify_beside(published) == (
        f"{record}: views.bin is stored in scene_1, and is not there; restore it from git",
    )


@pytest.mark.parametrize("content", ["{", "[]", '"digest"', '{"files_in": ["views.bin"]}', "\xff\xfe"])
def test_a_damaged_record_of_a_stage_is_one_problem(copied, content):
    record = copied.parent / "reference/scene_0/stage.json"
    record.write_bytes(content.encode("latin-1"))
    write_beside(copied.parent)
    (problem,) = verify_beside(copied.parent)
    assert problem.startswith(f"{record}: expected the record of a stage, ")
    assert "restore it from git" in problem
    assert not is_kept(copied)


def test_a_picture_of_something_else_is_found_by_drawing_it_again(copied):
    assert list(picture_problems(copied)) == []
    file = copied.parent / "simulated_excess.png"
    with Image.open(file) as picture:
        picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(file)
    (problem,) = picture_problems(copied)
    assert "shows something else than its drives" in problem


@pytest.mark.parametrize(
    ("steps_m", "sideways_m", "says"),
    [(1.5, 0.0, "a step of 0."), (1.0, 0.005, "rad off its heading"), (1.0, 0.0, "")],
)
def test_a_car_moves_along_its_heading_and_no_further_than_it_drives(copied, steps_m, sideways_m, says):
    """The pose of one tick is moved: along the car by half a step, or aside by 5 mm (4 degrees of a step of 0.07 m)."""
    world = World(copied.parents[2], copied.name, random.Random(0))
    file = copied / "own_hardened_gradient_2.json"
    data = json.loads(file.read_text())
    poses = poses_of(data, "surrogate", 1)
    along, aside = (
        np.array([np.cos(poses[30, 2]), np.sin(poses[30, 2])]) @ turn
        for turn in (np.eye(2), [[0, 1], [-1, 0]])
    )
    poses[30, :2] += (steps_m - 1.0) * 0.07 * along + sideways_m * aside
    world.set_drive(data, "surrogate", 1, poses)
    file.write_text(json.dumps(data))
    found = "\n".join(drive_problems(evidence_of(copied)))
    assert (says in found) if says else (found == "")


def test_a_registration_that_makes_no_sense_is_a_problem_and_no_crash(copied):
    data = json.loads((copied / FILE).read_text())
    data["scenarios"]["track"]["path"]["start_pose"][0] += 0.1
    data["scenarios"]["track"]["path"]["segments"] = data["scenarios"]["track"]["path"]["segments"][:1]
    (copied / FILE).write_text(json.dumps(data))
    (problem,) = verify_set(copied).problems
    assert "expected a closed path" in problem
    assert "restore it from git" in problem


def test_the_commands_of_a_set_of_a_user_name_the_file_that_was_registered(copied, tmp_path, monkeypatch):
    registered = read_registration(copied)
    assert registered is not None
    page = write_page(copied.parent).read_text()
    assert f"\n    advnerf experiment run {registered.file}\n" in page
    monkeypatch.chdir(tmp_path)
    assert registered_file("mine.campaign.yaml") == Path("mine.experiment.yaml")
    (tmp_path / "launch").mkdir()
    (tmp_path / "launch" / "mine.experiment.yaml").touch()
    assert registered_file("mine.campaign.yaml") == Path("launch/mine.experiment.yaml")
