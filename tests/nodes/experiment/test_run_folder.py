import io
import json

import pytest
from rich.console import Console

from nodes.experiment.engine.artefact import Settings
from nodes.experiment.engine.stages import Stage
from nodes.experiment.steps import run
from nodes.runtime.errors import ConfigError


@pytest.fixture
def run_in(tiny_file, monkeypatch):
    """Runs the one stage of an experiment in a folder."""

    def run_one(folder, name, value=1):
        stage = Stage(
            "capture",
            lambda here, told: (here / "photo").write_text(f"{name} {value}"),
            Settings.of(value=value),
        )
        monkeypatch.setattr(run, "stages_of", lambda experiment: [stage])
        experiment = run.load_experiment(tiny_file(name=name), "tiny", [], folder)
        run.make_ready(experiment, console=Console(file=io.StringIO()))

    return run_one


def test_the_folder_of_another_experiment_is_not_emptied(run_in, tmp_path):
    folder = tmp_path / "run"
    run_in(folder, "room")
    with pytest.raises(
        ConfigError, match=r"run folder of experiment 'town' .* of 'room'; name another one with --folder"
    ):
        run_in(folder, "town", 2)
    assert (folder / "capture" / "photo").read_text() == "room 1"
    run_in(folder, "room", 3)
    assert (folder / "capture" / "photo").read_text() == "room 3"
    # Who says so has its stages replaced; what cannot be read says nothing.
    (folder / "manifest.json").unlink()
    run_in(folder, "town", 2)
    assert json.loads((folder / "manifest.json").read_text())["experiment"] == "town"
    (folder / "manifest.json").write_text("{")
    run_in(folder, "room", 4)
    assert (folder / "capture" / "photo").read_text() == "room 4"
