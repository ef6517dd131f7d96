"""States and tables of experiments execute no code that a file names: each module here leaves a mark when it is executed."""

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from nodes.cli.main import app
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import runs_alone
from nodes.experiment.show.kept_worlds import keep_worlds
from nodes.experiment.steps.keys import settings_hash
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

EXAMPLES = Path(__file__).parents[3] / "examples"
OWN = ("world_warehouse", "my_architecture", "left_objective", "spiral_method")
CHANGES = [
    "policy.architecture=my_architecture.py:Mixer",
    "attack.objective=left_objective.py:LeftOffset",
    "over.method=[none,spiral_method.py:Spiral]",
    "deploy.world={kind: 'world_warehouse.py:Warehouse'}",
]
CELL = Cell("loop", "hardened", "none", 0)


class Yard:
    """An experiment of somebody else's code, its run folder, and the marks of modules that were executed."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "warehouse.experiment.yaml"
        self.run, self._marks = folder / "run", folder / "marks.txt"
        shutil.copy(EXAMPLES / self.file.name, self.file)
        for name in OWN:
            self.write(name, (EXAMPLES / f"{name}.py").read_text())

    def write(self, name: str, code: str) -> None:
        mark = f"\nopen({str(self._marks)!r}, 'a').write('{name} ')\n"
        (self.file.parent / f"{name}.py").write_text(code + mark)

    def executed(self) -> str:
        marks = self._marks.read_text() if self._marks.exists() else ""
        self._marks.unlink(missing_ok=True)
        for name in [each for each in sys.modules if each.startswith("advnerf_plugin_")]:
            del sys.modules[name]
        return marks

    def experiment(self, executes: bool):
        return load_experiment(self.file, "tiny", CHANGES, self.run, executes)

    def command(self, name: str, *options: str) -> str:
        changes = [word for change in CHANGES for word in ("--set", change)]
        done = CliRunner().invoke(
            app,
            [
                "experiment",
                name,
                str(self.file),
                "--setting",
                "tiny",
                "--folder",
                str(self.run),
                *changes,
                *options,
            ],
        )
        assert done.exit_code == 0, done.output
        return done.output


@pytest.fixture
def yard(tmp_path: Path) -> Yard:
    return Yard(tmp_path)


def test_a_run_that_was_never_made_has_its_cells_missing(yard):
    for name in ("status", "table", "report"):
        shown = yard.command(name)
        assert yard.executed() == "", name
        if name == "status":
            assert "done" not in shown
            assert "missing" in shown


@pytest.mark.parametrize("section", ["world", "deploy.world"])
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("junktion", "did you mean junction?"),
        ("'nowhere.py:World'", "expected a Python file at"),
        ("3", "expected kind: NAME"),
        ("[junction]", "expected kind: NAME"),
    ],
)
def test_a_world_that_stands_for_nothing_is_refused_as_a_run_refuses_it(yard, section, kind, said):
    for executes in (True, False):
        with pytest.raises(ConfigError, match=re.escape(said)):
            load_experiment(yard.file, "tiny", [f"{section}={{kind: {kind}}}"], yard.run, executes)
    assert yard.executed() == ""


def test_keys_without_the_code_are_those_with_it(yard):
    loaded = yard.experiment(executes=True)
    assert "world_warehouse" in yard.executed()
    keep_worlds(loaded.folder, loaded.named_worlds)
    yard.executed()
    kept = yard.experiment(executes=False)
    same = (settings_hash(kept, CELL), runs_alone(kept), [stage.settings for stage in stages_of(kept)])
    assert yard.executed() == ""
    assert same == (
        settings_hash(loaded, CELL),
        runs_alone(loaded),
        [stage.settings for stage in stages_of(loaded)],
    )


def test_a_finished_cell_is_done_without_its_code_until_the_code_changes(yard):
    loaded = yard.experiment(executes=True)
    keep_worlds(loaded.folder, loaded.named_worlds)
    drives = {"total_cte_m": [6.0], "off_track": [True], "none_total_cte_m": [2.0]}
    data = {
        "scenario": CELL.scenario,
        "victim": CELL.victim,
        "method": CELL.method,
        "seed": 0,
        "attack_id": None,
        "settings_hash": settings_hash(loaded, CELL),
        "seconds": 1.0,
        "machine": "m",
        "date": "d",
        "surrogate": drives,
        "deployed": drives,
    }
    file = loaded.cell_result(CELL)
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps(data))
    yard.executed()
    variants = yard.file.with_name("mine.experiment.yaml")
    changes = "".join(f"      {change.replace('=', ': ', 1)}\n" for change in CHANGES)
    variants.write_text(
        f"base: {yard.file.name}\nsetting: tiny\nname: mine\nrun_folder: {yard.run.parent / 'mine'}\n"
        f"over:\n  victim: [hardened]\n  method: [none]\n  variant:\n    loop:\n      over.path: [loop]\n      run_folder: {yard.run}\n{changes}"
    )
    for state in ("done", "changed"):
        shown = yard.command("status", "--only", "method=none,victim=hardened")
        assert state in shown.split()
        found = CliRunner().invoke(app, ["experiment", "status", str(variants)])
        assert ("done" in found.output.split()) == (state == "done")
        assert yard.executed() == ""
        yard.write("world_warehouse", (EXAMPLES / "world_warehouse.py").read_text() + "\n# another\n")
