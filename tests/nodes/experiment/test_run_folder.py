import io
import json
from types import SimpleNamespace

import pytest
from rich.console import Console

from nodes.experiment.engine.artefact import Settings
from nodes.experiment.engine.run_folder import RunFolder, run_to_end
from nodes.experiment.engine.stages import Stage
from nodes.runtime.errors import ConfigError


def run(folder, name, value=1):
    config = SimpleNamespace(name=name, model_dump=lambda **_: {"value": value})
    stage = Stage(
        "capture", lambda here, told: (here / "photo").write_text(f"{name} {value}"), Settings.of(value=value)
    )
    experiment = RunFolder(config, folder / f"{name}.experiment.yaml", folder, "demo")
    return run_to_end(experiment, [stage], ["numpy"], None, Console(file=io.StringIO()))


def test_the_folder_of_another_experiment_is_not_emptied(tmp_path):
    run(tmp_path, "room")
    with pytest.raises(
        ConfigError, match=r"run folder of experiment 'town' .* of 'room'; name another one with --folder"
    ):
        run(tmp_path, "town", 2)
    assert (tmp_path / "capture" / "photo").read_text() == "room 1"
    run(tmp_path, "room", 3)
    assert (tmp_path / "capture" / "photo").read_text() == "room 3"
    # Who says so has its stages replaced; what cannot be read says nothing.
    (tmp_path / "manifest.json").unlink()
    run(tmp_path, "town", 2)
    assert json.loads((tmp_path / "manifest.json").read_text())["experiment"] == "town"
    (tmp_path / "manifest.json").write_text("{")
    run(tmp_path, "room", 4)
    assert (tmp_path / "capture" / "photo").read_text() == "room 4"
