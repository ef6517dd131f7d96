"""The reference build that is kept with the code: whole, used, and small enough to be cloned."""

import json
import subprocess
from pathlib import Path

from nodes.experiment.reference import BUILD, PUBLISHED
from nodes.experiment.run import load_experiment
from nodes.experiment.stage_record import RECORD, digest_of, read_record

ROOT = Path(__file__).parents[3]
KEPT = ROOT / PUBLISHED / BUILD
MOST_BYTES = 40e6


def test_it_is_whole_and_small_enough():
    stages = sorted(file.parent for file in KEPT.glob(f"*/{RECORD}"))
    assert stages
    assert sorted(KEPT.iterdir()) == stages
    for stage in stages:
        assert digest_of(stage) == read_record(stage).kept, f"{stage} is not as it was kept"
    assert sum(file.stat().st_size for file in KEPT.rglob("*")) < MOST_BYTES


def test_git_ignores_none_of_it():
    if not (ROOT / ".git").exists():
        return
    files = [str(file) for file in KEPT.rglob("*")]
    done = subprocess.run(
        ["git", "check-ignore", *files], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout == ""


def test_published_cells_of_the_room_are_of_it(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    experiment = load_experiment(ROOT / "launch" / "room.experiment.yaml", "full", [], tmp_path)
    cells = sorted((ROOT / PUBLISHED / "room").glob("*.json"))
    assert cells
    for file in cells:
        assert json.loads(file.read_text())["stages"] == dict(experiment.kept), file.name
