"""What ``make clean`` removes and what it keeps, in a copy of the Makefile."""

import os
import pty
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MADE = (".venv/bin/python", ".ruff_cache/a", "nodes/__pycache__/a.pyc", "site/index.html")
KEPT = ("runs/full/bag/bag_0.mcap", "runs/full/__pycache__/a.pyc", "nodes/a.py", "launch/mine.launch.yaml")


@pytest.fixture
def folder(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in (*MADE, *KEPT):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    return tmp_path


def make(folder, *words, **options):
    return subprocess.run(
        ["make", *words], cwd=folder, capture_output=True, text=True, timeout=600, **options
    )


def present(folder):
    return {name for name in (*MADE, *KEPT) if (folder / name).exists()}


def test_clean_keeps_what_cannot_be_made_again_and_names_it(folder):
    done = make(folder, "clean")
    assert done.returncode == 0
    assert present(folder) == set(KEPT)
    assert "kept runs/" in done.stdout


def test_runs_are_removed_on_purpose_only(folder):
    done = make(folder, "clean-runs", stdin=subprocess.DEVNULL)
    assert done.returncode != 0
    assert "nothing is removed: give YES=1" in done.stdout
    assert present(folder) == {*MADE, *KEPT}
    assert make(folder, "clean-runs", "YES=1").returncode == 0
    assert not (folder / "runs").exists()
    assert make(folder, "clean-runs", "YES=1").returncode == 0
    assert make(folder, "clean").returncode == 0


@pytest.mark.parametrize(("answer", "removed"), [("yes", True), ("y", False), ("", False)])
def test_a_person_is_asked(folder, answer, removed):
    ours, theirs = pty.openpty()
    os.write(ours, f"{answer}\n".encode())
    done = make(folder, "clean-runs", stdin=theirs)
    os.close(theirs)
    os.close(ours)
    assert (not (folder / "runs").exists(), done.returncode == 0) == (removed, removed)
    assert "full" in done.stdout
