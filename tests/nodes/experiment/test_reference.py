"""The reference build that is kept with the code: whole, used, and small enough to be cloned."""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.data.image_files import read_stored
from nodes.experiment.engine.artefact import (
    BUILD,
    PUBLISHED,
    RECORD,
    Artefact,
    ReferenceBuild,
    ReferenceBuildError,
    digest_of,
    read_artefact,
    write_artefact,
)
from nodes.experiment.show.learned_scene import VIEWS, view_pictures
from tests.support.stage_versions import tiny_experiment

ROOT = Path(__file__).parents[3]
KEPT = ROOT / PUBLISHED / BUILD
MOST_BYTES = 60e6  # the junction's scene, objects and victims are 20 MB of it


def test_it_is_whole_without_second_copies_and_small_enough(tmp_path):
    stages = sorted(file.parent for file in KEPT.glob(f"*/{RECORD}"))
    assert stages
    assert sorted(KEPT.iterdir()) == stages
    for stage in stages:
        taken = ReferenceBuild(KEPT).take_digest(
            stage.name.rpartition("_")[0], read_artefact(stage).digest, "a key", tmp_path / stage.name
        )
        assert taken is not None, f"{stage} is not as it was kept"
        for path in read_artefact(stage).files_in:
            assert not (stage / path).exists(), "it is stored twice"
    # Two paths of one stage may begin alike, and so have one picture of their start.
    stored = [
        digest
        for stage in stages
        for digest in {
            digest_of_file(file) for file in stage.rglob("*") if file.is_file() and file.name != RECORD
        }
    ]
    assert len(set(stored)) == len(stored)
    assert sum(file.stat().st_size for file in KEPT.rglob("*")) < MOST_BYTES


def digest_of_file(file):
    return hashlib.sha256(file.read_bytes()).hexdigest()


def test_git_ignores_none_of_it():
    if not (ROOT / ".git").exists():
        return
    files = [str(file) for file in KEPT.rglob("*")]
    done = subprocess.run(
        ["git", "check-ignore", *files], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout == ""


def test_published_cells_of_the_room_are_of_it(tmp_path):
    """They are found by their digests: the keys are those of the version that published them."""
    build, cells = ReferenceBuild(KEPT), sorted((ROOT / PUBLISHED / "room").glob("*.json"))
    assert cells
    for name, digest in json.loads(cells[0].read_text())["stages"].items():
        taken = build.take_digest(name, digest, "another key", tmp_path / name)
        assert (taken.key, taken.digest) == ("another key", digest)
        assert read_artefact(tmp_path / name).key == "another key"
    assert build.take_digest("scene", "0" * 64, "another key", tmp_path / "none") is None


def made(work, key, **files):
    shutil.rmtree(work, ignore_errors=True)
    for name, content in files.items():
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        (work / name).write_bytes(content)
    write_artefact(work, Artefact(key, digest_of(work), 1.0, {}))
    return work


def test_files_of_two_stages_are_stored_once_and_both_are_taken(tmp_path):
    build, work = ReferenceBuild(tmp_path / "build"), tmp_path / "run" / "scene"
    kept = {"b" * 64: b"its own", "a" * 64: b"another", "c" * 64: b"its own"}
    for key, own in kept.items():
        folder = made(
            work,
            key,
            **{"scene.bin": b"the same", "views/0.png": b"drawn again", "views/own": own, "own": own},
        )
        assert build.keep("scene", key, folder, ("views",)) == build.folder / f"scene_{key[:16]}"
        assert build.keep("scene", key, folder) is None
    found = sorted(
        file.relative_to(build.folder).as_posix()[6] + file.name
        for file in build.folder.rglob("*")
        if file.is_file()
    )
    assert found == ["a" + "own", "a" + RECORD, "b" + "own", "bscene.bin", "b" + RECORD, "c" + RECORD]
    for key, own in kept.items():
        taken = build.take("scene", key, tmp_path / key)
        assert (taken.key, taken.files_in) == (key, {})
        assert (tmp_path / key / "scene.bin").read_bytes() == b"the same"
        assert (tmp_path / key / "own").read_bytes() == own
        assert not (tmp_path / key / "views").exists()
        assert read_artefact(tmp_path / key).key == key


@pytest.mark.parametrize("damage", ["changed", "gone"])
def test_a_damaged_file_is_named_wherever_it_is_stored(tmp_path, damage):
    build = ReferenceBuild(tmp_path / "build")
    for key in ("a" * 64, "b" * 64):
        build.keep("scene", key, made(tmp_path / "run", key, **{"scene.bin": b"the same"}))
    (stored,) = build.folder.rglob("scene.bin")
    stored.write_bytes(b"something else") if damage == "changed" else stored.unlink()
    for key in ("a" * 64, "b" * 64):
        with pytest.raises(ReferenceBuildError, match="as they were kept, got others"):
            build.take("scene", key, tmp_path / "taken")
    assert not (tmp_path / "taken").exists()


def test_pictures_of_held_out_views_that_are_not_stored_are_drawn_again(tiny_room):
    experiment = tiny_experiment(tiny_room[0])
    for index in (0, 2):
        for name, drawn in view_pictures(experiment, index).items():
            file = experiment.stage_folder("scene") / VIEWS / f"{index:03d}_{name}.png"
            np.testing.assert_array_equal(drawn, read_stored(file)[0])
