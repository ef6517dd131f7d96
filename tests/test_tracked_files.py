"""What the repository may weigh, as it is cloned."""

import subprocess
from pathlib import Path

import pytest

from nodes.experiment.run.set_film import MOST_BYTES

ROOT = Path(__file__).parents[1]
# 45 MB; paper_car: scenes and victims of two places 19 MB, drives and textures of its 106 cells 16 MB; paper_junction: its build 20 MB, and
# 28 MB for its 147 cells; metadrive_billboard, metadrive_run_wide and victims of Duckietown 14 MB, less 9 MB of explorations;
# paper_junction_sides: 12 MB, half of it the textures of five objects in each of 12 attacks; paper_monitor: 5 MB, without its scene and victim;
# retrain: 3 MB, its two policies; paper_spaces: 26 MB, three quarters of it the meshes and places of its 66 attacks.
# metadrive_victims: 9 MB, 112 cells and two more victims. victim_panel: 12 MB, 49 cells and five more victims. paper_car_sides,
# paper_car_long and paper_monitor_wall: 5 MB each, 37 cells.
MOST_TRACKED_BYTES = 215_000_000


@pytest.fixture(scope="module")
def tracked():
    if not (ROOT / ".git").exists():
        pytest.skip("no repository here")
    names = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    return [file for name in names.split("\0") if name and (file := ROOT / name).is_file()]


def test_tracked_files_keep_to_their_budget(tracked):
    sizes = {file.relative_to(ROOT).as_posix(): file.stat().st_size for file in tracked}
    largest = sorted(sizes, key=sizes.__getitem__)[-5:]
    assert sum(sizes.values()) <= MOST_TRACKED_BYTES, f"the largest are {largest}"


def test_films_of_published_sets_are_at_most_180_kb(tracked):
    films = [file for file in tracked if file.match("docs/results/*.webp")]
    assert films
    assert {file.name: file.stat().st_size for file in films if file.stat().st_size > MOST_BYTES} == {}
    assert MOST_BYTES == 180_000
