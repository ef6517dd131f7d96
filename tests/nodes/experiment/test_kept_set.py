"""A tiny set is registered, run and published; then nothing but the published files is left, and it is driven again."""

import shutil
from dataclasses import replace

import pytest

from advnerf_core.attack.artifact import load_attack, save_attack
from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.hardness import PUBLISHED_FILE
from advnerf_core.report.evidence.kept_build import LOST
from advnerf_core.report.evidence.registration import FILE, PrimaryTest, read_registration
from advnerf_core.report.evidence.verify import verify_set
from nodes.experiment.engine.artefact import BUILD, RECORD, ReferenceBuild, read_artefact, write_artefact
from nodes.experiment.run import kept_attacks
from nodes.experiment.run.cells import keep_build
from nodes.experiment.run.kept_attacks import FOLDER, attack_problems, publish_attacks, with_attacks
from nodes.experiment.run.plan import statuses
from nodes.experiment.run.published import publish, publish_build
from nodes.experiment.run.redrive import RedriveError, redrive
from nodes.experiment.run.registering import register
from nodes.experiment.run.run import Options, run_cells
from nodes.experiment.steps import run
from tests.support.published import write_set
from tests.support.stage_versions import tiny_experiment

CHANGES = (
    "over.method=[none,gradient]",
    "over.seed=[0,1]",
    "measure.starts=2",
    "deploy.starts=1",
    "horizon=4",
    "attack.horizon=3",
)


def experiment_in(folder, *more):
    return tiny_experiment(folder, [*CHANGES, *more])


@pytest.fixture
def published(tiny_room, tmp_path, monkeypatch):
    """Folder of a published set, and its experiment."""
    build, results = ReferenceBuild(tmp_path / "trained"), tmp_path / "docs" / "results"
    assert keep_build(tiny_experiment(tiny_room[0]), build)
    monkeypatch.setattr(run, "REFERENCE", build)
    monkeypatch.chdir(tmp_path)
    experiment = experiment_in(tmp_path / "run")
    register(experiment, experiment.cells, results)
    run.make_ready(experiment, "policy")
    ended = run_cells(
        experiment, experiment.cells, Options(here=True, ready=True, gate=False), lambda text: None
    )
    assert {end.how for end in ended} == {"done"}
    publish(experiment, statuses(experiment, experiment.cells), results)
    assert len(publish_build(experiment, experiment.cells, results).written) == 4
    write_set(results / experiment.config.name)
    shutil.rmtree(build.folder)
    for file in (results / BUILD).glob(f"*/{RECORD}"):  # an earlier version had other keys
        write_artefact(file.parent, replace(read_artefact(file.parent), key="0" * 64))
    monkeypatch.setattr(run, "REFERENCE", ReferenceBuild(results / BUILD))
    return results / experiment.config.name, experiment


def of_claimed_methods_alone(published, experiment, monkeypatch):
    """Whether a set that claims something of another method than its large attacks' publishes none of them, and needs none."""
    found, folder = statuses(experiment, experiment.cells), published.parent / "large"
    shutil.copytree(published, folder, ignore=shutil.ignore_patterns("attacks"))
    file = folder / FILE
    registration = read_registration(folder)
    claimed = PrimaryTest(
        scenario=registration.cells[0].scenario, victim="hardened", method="cem", against=("none",)
    )
    file.write_text(registration.model_copy(update={"primary": (claimed,)}).model_dump_json())
    small = publish_attacks(experiment, found, folder)
    shutil.rmtree(folder / FOLDER)
    monkeypatch.setattr(kept_attacks, "SMALL_BYTES", 0)
    large = publish_attacks(experiment, found, folder)
    problems = list(attack_problems(folder))
    shutil.rmtree(folder)
    return len(small) == 2 and large == [] and problems == []


def test_it_is_driven_again_from_the_published_files_alone(published, tmp_path, monkeypatch):
    published, experiment = published
    assert of_claimed_methods_alone(published, experiment, monkeypatch)
    shutil.rmtree(experiment.folder)
    found = verify_set(published)
    assert with_attacks(found, published).problems == ()
    searched = [cell for cell in read_cells(published) if cell.attack_id]
    assert {file.stem for file in (published / "attacks").iterdir()} == {cell.attack_id for cell in searched}
    assert not (published / PUBLISHED_FILE).exists()  # nobody judged its victim
    page = (published.parent / "transfer.md").read_text()
    assert "trained with textures" in page
    assert "hardened" not in page
    assert LOST not in page

    again = redrive(experiment_in(tmp_path / "again"), published, 3, 0, lambda text: None)
    assert len(again) == 3
    # What is kept is what drove, so that poses come out as they were written: to the last digit that is kept.
    assert max(each.off_m for each in again) < 2e-5
    assert not list((tmp_path / "again" / "policy").glob("data*"))  # no victim was trained for it

    with pytest.raises(
        RedriveError,
        match="expected the held_cap_m that were registered, got others; drive it again with the version",
    ):
        redrive(experiment_in(tmp_path / "other", "held_cap_m=2"), published, 1, 0, lambda text: None)

    # With another texture it would not.
    first = sorted((published / "attacks").iterdir())[0]
    attack = load_attack(first)
    other = replace(attack.objects[0], theta=-attack.objects[0].theta)
    save_attack(first, replace(attack, objects=(other,)), small=True)
    (problem,) = attack_problems(published)
    assert "expected attack, victim, method and seed" in problem
    first.unlink()
    assert any("found none" in text for text in attack_problems(published))

    shutil.rmtree(published.parent / BUILD)
    with pytest.raises(RedriveError, match=f"room {LOST}"):
        redrive(experiment_in(tmp_path / "again"), published, 1, 0, lambda text: None)
