import os
from dataclasses import replace

import pytest

from advnerf_core.files import write_atomically
from nodes.experiment.engine.artefact import (
    ReferenceBuild,
    ReferenceBuildError,
    Settings,
    digest_of,
    read_artefact,
)
from nodes.experiment.engine.stages import (
    Stage,
    StageError,
    begun_with,
    keep_stages,
    outdated,
    run_stages,
    stage_digests,
)
from nodes.runtime.locks import hold

pytestmark = pytest.mark.live


class Notes:
    def __init__(self):
        self.events = []

    def start(self, stage):
        self.events.append(("start", stage))
        return lambda fraction, text="": self.events.append((stage, fraction))

    def finish(self, stage, seconds, cached):
        self.events.append(("cached" if cached else "done", stage))

    @property
    def ran(self):
        return [name for kind, name in self.events if kind == "done"]


def writing(text):
    return lambda folder, report: write_atomically(folder / "out.txt", text)


def job(first_setting=1, second_setting=1, first_text="a"):
    return [
        Stage("first", writing(first_text), Settings.of(x=first_setting)),
        Stage("second", writing("b"), Settings.of(y=second_setting), after=("first",)),
        Stage("other", writing("c"), Settings.of()),
    ]


def test_a_second_run_does_nothing(tmp_path):
    assert run_and_note(tmp_path, job()) == ["first", "second", "other"]
    assert run_and_note(tmp_path, job()) == []


def run_and_note(folder, stages, until=None):
    notes = Notes()
    run_stages(stages, folder, notes, until)
    return notes.ran


def test_a_changed_setting_runs_what_depends_on_it_and_no_more(tmp_path):
    run_and_note(tmp_path, job())
    assert run_and_note(tmp_path, job(second_setting=2)) == ["second"]
    # The first stage runs again but writes the same bytes, so what follows still fits.
    assert run_and_note(tmp_path, job(first_setting=2, second_setting=2)) == ["first"]
    assert run_and_note(tmp_path, job(first_setting=3, second_setting=2, first_text="new")) == [
        "first",
        "second",
    ]


def test_an_interrupted_stage_finds_its_own_partial_work(tmp_path):
    seen = []

    def work(folder, report):
        seen.append((folder / "partial").exists())
        (folder / "partial").write_text("half")
        if len(seen) == 1:
            raise KeyboardInterrupt

    stages = [Stage("long", work, Settings.of())]
    with pytest.raises(KeyboardInterrupt):
        run_and_note(tmp_path, stages)
    assert read_artefact(tmp_path / "long").digest is None
    assert run_and_note(tmp_path, stages) == ["long"]
    assert seen == [False, True]


def test_more_of_the_same_goes_on_from_what_is_there(tmp_path):
    def growing(rounds, seed=0):
        def work(folder, report):
            for number in range(rounds):
                if not (file := folder / f"round{number}").exists():
                    file.write_text(f"made when {rounds} were asked for")

        of = [Settings.of(rounds=fewer, seed=seed) for fewer in range(1, rounds)]
        return [Stage("loop", work, Settings.of(rounds=rounds, seed=seed), resumes_from=of)]

    def rounds():
        return [file.read_text()[10:11] for file in sorted((tmp_path / "loop").glob("round*"))]

    assert begun_with(growing(3), tmp_path, "loop") is None
    run_and_note(tmp_path, growing(2))
    assert begun_with(growing(3), tmp_path, "loop") == Settings.of(rounds=2, seed=0)
    assert begun_with(growing(3, seed=1), tmp_path, "loop") is None
    assert run_and_note(tmp_path, growing(3)) == ["loop"]
    assert begun_with(growing(3), tmp_path, "loop") == Settings.of(rounds=3, seed=0)
    assert begun_with(growing(2), tmp_path, "loop") is None
    assert rounds() == ["2", "2", "3"]
    assert run_and_note(tmp_path, growing(3)) == []
    assert run_and_note(tmp_path, growing(2)) == [
        "loop"
    ]  # fewer are made anew: what is left of more would be taken for them
    assert rounds() == ["2", "2"]
    run_and_note(tmp_path, growing(3, seed=1))
    assert rounds() == ["3", "3", "3"]


def test_partial_work_of_other_settings_is_not_used(tmp_path):
    def fail(folder, report):
        (folder / "partial").write_text("half")
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError):
        run_and_note(tmp_path, [Stage("s", fail, Settings.of(x=1))])
    run_and_note(tmp_path, [Stage("s", writing("whole"), Settings.of(x=2))])
    assert not (tmp_path / "s" / "partial").exists()


def test_an_unreadable_record_runs_the_stage_again(tmp_path):
    run_and_note(tmp_path, job())
    (tmp_path / "first" / "stage.json").write_text("{")
    assert run_and_note(tmp_path, job()) == ["first"]


def test_until_stops_after_the_named_stage_and_unknown_names_are_refused(tmp_path):
    assert run_and_note(tmp_path, job(), until="second") == ["first", "second"]
    with pytest.raises(StageError, match="first, second, other; got 'third'"):
        run_and_note(tmp_path, job(), until="third")
    with pytest.raises(StageError, match="'b' needs a"):
        run_and_note(tmp_path, [Stage("b", writing(""), Settings.of(), after=("a",))])


def test_the_digest_sees_names_and_contents(tmp_path):
    write_atomically(tmp_path / "a", "1")
    before = digest_of(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    renamed = digest_of(tmp_path)
    write_atomically(tmp_path / "b", "2")
    assert len({before, renamed, digest_of(tmp_path)}) == 3


def test_two_processes_do_not_make_one_stage(tmp_path):
    """Whoever comes second is told who is at work, and what is finished already is read all the same."""
    run_and_note(tmp_path, job(), until="first")
    lock = hold(tmp_path / ".second.lock")
    with (
        lock,
        pytest.raises(
            StageError, match=rf"second for this process alone, but process {os.getpid()} is at work there"
        ),
    ):
        run_and_note(tmp_path, job())
    assert not (tmp_path / "second").exists()
    assert run_and_note(tmp_path, job()) == ["second", "other"]


def test_files_that_no_stage_wrote_are_not_wiped(tmp_path):
    (tmp_path / "first").mkdir()
    mine = tmp_path / "first" / "photograph.jpg"
    mine.write_bytes(b"an hour's work")
    with pytest.raises(StageError, match="no stage wrote"):
        run_and_note(tmp_path, job())
    assert mine.read_bytes() == b"an hour's work"


def photographed(second_setting=1, third_setting=1):
    """Three stages, of which the second reads what the first leaves out of a reference build, and the third does not."""

    def photograph(folder, report):
        write_atomically(folder / "photos" / "0.jpg", "large")
        write_atomically(folder / "world.json", "{}")

    def learn(folder, report):
        assert (folder.parent / "first" / "photos" / "0.jpg").read_text() == "large"
        write_atomically(folder / "scene", f"learned {second_setting}")

    return [
        Stage("first", photograph, Settings.of(), bulk=("photos",)),
        Stage("second", learn, Settings.of(y=second_setting), after=("first",), reads_bulk_of=("first",)),
        Stage("third", writing("c"), Settings.of(z=third_setting), after=("first", "second")),
    ]


def run_with(reference, folder, stages):
    notes = Notes()
    records = run_stages(stages, folder, notes, reference=reference)
    return notes.ran, records


def test_a_machine_with_a_reference_build_goes_on_from_it(tmp_path):
    reference, ours, theirs = ReferenceBuild(tmp_path / "build"), tmp_path / "ours", tmp_path / "theirs"
    ran, records = run_with(reference, ours, photographed())
    assert ran == ["first", "second", "third"]
    assert [each.name.split("_")[0] for each in keep_stages(photographed(), ours, reference)] == ran
    assert keep_stages(photographed(), ours, reference) == []
    assert stage_digests(photographed(), theirs, reference) == {
        name: each.digest for name, each in records.items()
    }
    ran, again = run_with(reference, theirs, photographed())
    assert ran == []
    assert [each.digest for each in again.values()] == [each.digest for each in records.values()]
    assert (theirs / "first" / "world.json").exists()
    assert not (theirs / "first" / "photos").exists()
    # What reads nothing that was left out goes on from there; what does has it made again.
    assert run_with(reference, theirs, photographed(third_setting=2))[0] == ["third"]
    assert run_with(reference, theirs, photographed(second_setting=2))[0] == ["first", "second", "third"]
    assert (theirs / "first" / "photos" / "0.jpg").exists()


def test_stages_that_a_run_would_make_anew_are_known_before(tmp_path):
    run_and_note(tmp_path, job())
    for changed, expected in ((job(), []), (job(2), ["first", "second"]), (job(1, 2), ["second"])):
        assert outdated(changed, tmp_path) == expected
        assert outdated(job(1, 2, "never run"), tmp_path / "none") == []
    fewer = [*job(2)[:1], replace(job()[2], settings=Settings.of(rounds=3), resumes_from=[Settings.of()])]
    assert outdated(fewer, tmp_path) == ["first"]  # the other is resumed
    assert run_and_note(tmp_path, job(2)) == ["first"]  # of the same content, so that what it leads to stays
    assert outdated(job(2), tmp_path) == []


def test_without_the_reference_build_all_is_made(tmp_path):
    reference = ReferenceBuild(tmp_path / "build")
    run_with(reference, tmp_path / "ours", photographed())
    keep_stages(photographed(), tmp_path / "ours", reference)
    assert run_with(None, tmp_path / "theirs", photographed())[0] == ["first", "second", "third"]


def test_a_damaged_reference_build_is_refused(tmp_path):
    reference, ours = ReferenceBuild(tmp_path / "build"), tmp_path / "ours"
    run_with(reference, ours, photographed())
    scene = next(each for each in keep_stages(photographed(), ours, reference) if "second" in each.name)
    (scene / "scene").write_text("version https://git-lfs.github.com/spec/v1")
    with pytest.raises(ReferenceBuildError, match=r"second_\w+ as they were kept, got others"):
        run_with(reference, tmp_path / "theirs", photographed())


def test_files_of_a_user_are_not_replaced_by_a_reference_build(tmp_path):
    reference, ours = ReferenceBuild(tmp_path / "build"), tmp_path / "ours"
    run_with(reference, ours, photographed())
    keep_stages(photographed(), ours, reference)
    mine = tmp_path / "theirs" / "first" / "photograph.jpg"
    write_atomically(mine, "an hour's work")
    with pytest.raises(StageError, match="no stage wrote"):
        run_with(reference, tmp_path / "theirs", photographed())
    assert mine.read_text() == "an hour's work"
