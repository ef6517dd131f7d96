"""Git as the witness of the published results, in small repositories made with git."""

import json
import shutil
import subprocess

import pytest

from advnerf_core.report.evidence.registration import SetError
from advnerf_core.report.evidence.verifying.history import verify_history

GIT = ("git", "-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
REGISTRATION, CELL, FILM = "one/set/registration.json", "one/track_none_0.json", "one_drives.webp"
MISSED = {
    "line": "photos",
    "value": 20.0,
    "unit": "dB",
    "met": False,
    "target": ">= 26 dB",
    "date": "2026-01-01T10:00:00+00:00",
    "command": "bench",
    "machine": "m",
    "note": "",
}


class Repository:
    """Published results of one set: its registration was committed, then its cells and everything else."""

    def __init__(self, root):
        self.root, self.published = root, root / "docs" / "results"
        self.git("init", "-q")
        self.write(REGISTRATION, {"scenarios": {"track": {}, "own": {}}})
        self.commit()
        for name in (CELL, "one/track_gradient_0.json", "one/gate/track.json", "one/set/set.json", FILM):
            self.write(name, {"is": name})
        self.write("reference/scene_0/weights.json", [1.0])
        self.write("../results.json", [MISSED])
        self.commit()

    def git(self, *arguments):
        command = [*GIT, "-C", str(self.root), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def write(self, name, data):
        file = self.published / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(data))

    def commit(self):
        self.git("add", "-A")
        self.git("commit", "-q", "-m", "x")

    def problems(self):
        found = verify_history(self.published)
        assert found.not_checked == ""
        return found.problems


@pytest.fixture
def repository(tmp_path):
    return Repository(tmp_path)


def test_a_set_as_it_was_committed_has_no_problem(repository):
    found = verify_history(repository.published)
    assert (found.not_checked, found.problems, found.removed) == ("", (), 0)
    assert found.files == 7
    # What is made from other files, and what is new, may change.
    repository.write("one/set/set.json", {"other": "numbers"})
    repository.write("one/track_gradient_1.json", {})
    repository.write("two/set/registration.json", {"scenarios": {}})
    assert repository.problems() == ()


def amend_the_registration(repository):
    repository.write(REGISTRATION, {"scenarios": {"track": {}, "own": {}}, "limit": 2})


def change_a_cell(repository):
    repository.write(CELL, {"is": "better"})


def change_a_verdict(repository):
    repository.write("one/gate/track.json", {"passed": True})


def change_a_film(repository):
    repository.write(FILM, {"shows": "more"})


def change_the_reference_build(repository):
    repository.write("reference/scene_0/weights.json", [2.0])


def remove_the_set(repository):
    shutil.rmtree(repository.published / "one")


def remove_a_cell(repository):
    (repository.published / CELL).unlink()


def remove_a_scenario(repository):
    repository.write(REGISTRATION, {"scenarios": {"track": {}}})


def remove_a_missed_row(repository):
    repository.write("../results.json", [])


def turn_a_verdict(repository):
    repository.write("../results.json", [{**MISSED, "met": True}])


def change_a_value(repository):
    repository.write("../results.json", [{**MISSED, "value": 27.0, "met": True}])


@pytest.mark.parametrize("committed", [False, True])
@pytest.mark.parametrize(
    ("change", "says", "log"),
    [
        (amend_the_registration, "registration.json: ", None),
        (change_a_cell, "track_none_0.json: was changed", ("file", CELL)),
        (change_a_verdict, "gate/track.json: was changed", ("file", "one/gate/track.json")),
        (change_a_film, "one_drives.webp: was changed", ("file", FILM)),
        (change_the_reference_build, "weights.json: was changed", ("file", "reference/scene_0/weights.json")),
        (remove_the_set, "the set one was committed once", ("set", "one")),
        (remove_a_cell, f"the file {CELL} was committed once", ("file", CELL)),
        (remove_a_scenario, "the scenario one/own was committed once", None),
        (remove_a_missed_row, "the row 'photos' was missed and is gone", ("row", "photos")),
        (turn_a_verdict, "the row 'photos' has another verdict", ("value", "photos", 20.0)),
        (change_a_value, "the row 'photos' had the value 20.0 and has 27.0", ("value", "photos", 27.0)),
    ],
)
def test_what_was_changed_or_removed_is_found_and_may_be_logged(repository, change, says, log, committed):
    change(repository)
    if committed:
        repository.commit()
    assert says in "\n".join(repository.problems())
    if log is None:  # whatever is logged, cells are no younger than a registration that was written again
        assert committed is False or "does not come after its registration" in "\n".join(
            repository.problems()
        )
        return
    kind, name, *value = log
    entry = {"kind": kind, "names": [name], "reason": "It was wrong by a factor."}
    repository.write("removed.json", [entry | ({"stands": {name: value[0]}} if value else {})])
    assert repository.problems() == ()


def test_a_registration_may_be_written_again_before_its_cells_if_that_is_logged(tmp_path):
    repository = Repository.__new__(Repository)
    repository.root, repository.published = tmp_path, tmp_path / "docs" / "results"
    repository.git("init", "-q")
    for limit in (1, 2):
        repository.write(REGISTRATION, {"scenarios": {}, "limit": limit})
        repository.commit()
    repository.write(CELL, {})
    repository.commit()
    (problem,) = repository.problems()
    assert "was changed in" in problem
    assert "removed.json does not say why" in problem
    entry = {"kind": "registration", "names": ["one"], "reason": "Nothing had been run.", "commit": "0"}
    repository.write("removed.json", [entry])
    assert repository.problems() == ()


def test_a_cell_that_was_committed_with_its_registration_or_before_is_found(repository):
    text = (repository.published / REGISTRATION).read_text()
    (repository.published / REGISTRATION).unlink()
    repository.commit()
    (repository.published / REGISTRATION).write_text(text)
    assert "was not committed" in "\n".join(repository.problems())
    repository.commit()
    found = repository.problems()
    assert len(found) == 2
    assert all("does not come after its registration" in each for each in found)


def test_order_is_by_ancestry_and_not_by_date(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_COMMITTER_DATE", "2030-01-01T00:00:00Z")
    monkeypatch.setenv("GIT_AUTHOR_DATE", "2030-01-01T00:00:00Z")
    repository = Repository(tmp_path)
    monkeypatch.setenv("GIT_COMMITTER_DATE", "2020-01-01T00:00:00Z")
    repository.write("one/track_gradient_1.json", {})
    repository.commit()
    assert repository.problems() == ()


def test_a_row_that_a_merge_lost_is_found(repository):
    repository.git("checkout", "-q", "-b", "side")
    repository.write("../results.json", [MISSED, {**MISSED, "line": "other"}])
    repository.commit()
    repository.git("checkout", "-q", "-")
    repository.write("one/track_gradient_1.json", {})
    repository.commit()
    repository.git("merge", "-q", "-s", "ours", "-m", "x", "side")
    (problem,) = repository.problems()
    assert "the row 'other' was missed and is gone" in problem


def test_a_row_that_was_measured_again_may_have_another_value(repository):
    again = {**MISSED, "value": 27.0, "met": True, "date": "2026-01-01T10:00:01+00:00"}
    repository.write("../results.json", [again])
    assert repository.problems() == ()


def test_a_logged_value_covers_neither_another_value_nor_a_removal(repository):
    entry = {"kind": "value", "names": ["photos"], "reason": "It was rounded.", "stands": {"photos": 27.0}}
    repository.write("removed.json", [entry])
    for rows, says in (
        ([{**MISSED, "value": 27.0}], ""),
        ([{**MISSED, "value": 28.0}], "had the value 20.0 and has 28.0"),
        ([], "was missed and is gone"),
    ):
        repository.write("../results.json", rows)
        assert says in "".join(repository.problems())
        assert bool(repository.problems()) == bool(says)


@pytest.mark.parametrize("stands", [{}, {"other": 1.0}])
def test_a_logged_value_names_the_value_of_each_row(repository, stands):
    entry = {"kind": "value", "names": ["photos"], "reason": "It was rounded.", "stands": stands}
    repository.write("removed.json", [entry])
    with pytest.raises(SetError, match="expected stands to hold the value of each row"):
        verify_history(repository.published)


def test_without_a_history_it_says_why(repository, tmp_path_factory, monkeypatch):
    alone = tmp_path_factory.mktemp("alone") / "results"
    shutil.copytree(repository.published, alone)
    assert "not a git repository" in verify_history(alone).not_checked
    shallow = alone.parent / "shallow"
    subprocess.run(["git", "clone", "-q", "--depth", "1", repository.root.as_uri(), str(shallow)], check=True)
    assert "shallow clone" in verify_history(shallow / "docs" / "results").not_checked
    empty = alone.parent / "empty"
    (empty / "docs").mkdir(parents=True)
    subprocess.run(["git", "init", "-q", str(empty)], check=True)
    assert verify_history(empty / "docs").not_checked
    monkeypatch.setenv("PATH", "")
    assert "git cannot be run" in verify_history(repository.published).not_checked


def test_a_damaged_log_is_an_error(repository):
    repository.write("removed.json", [{"kind": "row", "names": []}])
    with pytest.raises(SetError, match="expected a list of removals with their reasons"):
        verify_history(repository.published)
