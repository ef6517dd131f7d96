"""The reference build that is kept with the code: whole, used, and small enough to be cloned."""

import json
import subprocess
from pathlib import Path

from nodes.experiment.engine.artefact import (
    BUILD,
    PUBLISHED,
    RECORD,
    Artefact,
    ReferenceBuild,
    digest_of,
    read_artefact,
    write_artefact,
)

ROOT = Path(__file__).parents[3]
KEPT = ROOT / PUBLISHED / BUILD
MOST_BYTES = 40e6


def test_it_is_whole_and_small_enough():
    stages = sorted(file.parent for file in KEPT.glob(f"*/{RECORD}"))
    assert stages
    assert sorted(KEPT.iterdir()) == stages
    for stage in stages:
        record = read_artefact(stage)
        files = stage.with_name(record.files_in or stage.name)
        assert digest_of(files) == record.kept, f"{files} is not as it was kept"
        assert not record.files_in or [file.name for file in stage.iterdir()] == [RECORD]
    kept = [read_artefact(stage) for stage in stages]
    large = [
        (stage.name[:5], each.kept)
        for stage, each in zip(stages, kept, strict=True)
        if stage.name[:5] == "scene" and not each.files_in
    ]
    assert len(set(large)) == len(large), "a scene is kept twice"
    assert sum(file.stat().st_size for file in KEPT.rglob("*")) < MOST_BYTES


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


def test_two_stages_with_the_same_files_are_kept_once_and_both_are_taken(tmp_path):
    build, work = ReferenceBuild(tmp_path / "build"), tmp_path / "run" / "scene"
    work.mkdir(parents=True)
    (work / "scene.bin").write_bytes(b"the same")
    for key in ("a" * 64, "b" * 64):
        write_artefact(work, Artefact(key, digest_of(work), 1.0, {}))
        assert build.keep("scene", key, work) == build.folder / f"scene_{key[:16]}"
        assert build.keep("scene", key, work) is None
    assert sorted(file.name for file in build.folder.rglob("*") if file.is_file()) == [
        "scene.bin",
        RECORD,
        RECORD,
    ]
    for key in ("a" * 64, "b" * 64):
        taken = build.take("scene", key, tmp_path / key)
        assert (taken.key, taken.files_in) == (key, "")
        assert (tmp_path / key / "scene.bin").read_bytes() == b"the same"
        assert read_artefact(tmp_path / key).key == key
