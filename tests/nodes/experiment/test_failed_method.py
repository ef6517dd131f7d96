"""A method that fails costs an experiment its own rows, not the report."""

import json
import shutil

from rich.console import Console

from nodes.experiment.run import whole
from nodes.experiment.steps.run import load_experiment
from tests.support.stage_versions import ROOT, TINY

BROKEN = """
from advnerf_core.attack.methods import Method
from advnerf_core.attack.search.random_search import search


def fails(problem, settings, run):
    raise RuntimeError("no luck today")


Broken = Method({search})
"""


def run(folder, method):
    """Cells and report with a method of a user's file beside random textures; what was printed, and how the cells ended."""
    changes = [*TINY, "attack.horizon=2", f"over.method=[none,random, '{method}:Broken']"]
    experiment = load_experiment(ROOT / "launch" / "room.experiment.yaml", "demo", changes, folder)
    console = Console(width=400, record=True, quiet=False)
    ended = whole.run_experiment(experiment, console=console)
    return console.export_text(), {end.name: end.how for end in ended}


def test_the_report_is_of_what_is_done_and_names_what_failed(tiny_room, tmp_path):
    folder, method = tmp_path / "run", tmp_path / "mine.py"
    shutil.copytree(tiny_room[0], folder, ignore=shutil.ignore_patterns("cells"))
    method.write_text(BROKEN.format(search="fails"))
    printed, ended = run(folder, method)
    assert ended == {
        "track_hardened_none_0": "done",
        "track_hardened_random_0": "done",
        "track_hardened_Broken_0": "failed",
    }
    failed = "not in the report, as a cell failed: Broken (track_hardened_Broken_0: "
    assert failed in printed
    page = (folder / "report" / "report.html").read_text()
    assert failed in page
    assert "no luck today" in page
    table = json.loads((folder / "report" / "table.json").read_text())["cells"]
    assert {cell["method"] for cell in table.values()} == {"none", "random"}
    # The method is mended: its cell is run, and the report is whole.
    method.write_text(BROKEN.format(search="search"))
    printed, ended = run(folder, method)
    assert ended == {"track_hardened_Broken_0": "done"}
    assert "not in the report" not in printed
    assert "no luck" not in (folder / "report" / "report.html").read_text()
    table = json.loads((folder / "report" / "table.json").read_text())["cells"]
    assert {cell["method"] for cell in table.values()} == {"none", "random", "Broken"}
