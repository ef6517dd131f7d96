"""Experiments over toy cells in real processes."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import MappingProxyType

import pytest

from nodes.experiment.run import (
    admission,
    gate,
    maps,
    plan,
    predictions,
    published,
    run,
    worker,
)
from tests.support import toy_cells, toy_pictures

MODULES = (admission, gate, maps, plan, predictions, published, run, worker)


@pytest.fixture
def gated(here, monkeypatch):
    """The bench with a learned scene: cells have real and learned pictures."""
    (here.folder / "gated").touch()
    monkeypatch.setattr(gate, "fidelity", toy_pictures)
    return here


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """A folder with an experiment of toy cells: one path, two seeds, two methods."""
    toy_cells.put_over(monkeypatch, MODULES)
    monkeypatch.setattr(worker, "module_command", toy_cells.command)
    monkeypatch.setattr("nodes.experiment.steps.run.load_experiment", toy_cells.load_experiment)
    return Bench(tmp_path)


@pytest.fixture
def here(bench, monkeypatch):
    """The bench, whose workers find the toy cells."""
    monkeypatch.setenv("PYTHONPATH", bench.environment["PYTHONPATH"])
    return bench


class Bench:
    def __init__(self, folder):
        self.folder = folder
        self.cells = folder / "cells"
        self.file = folder / "toy.experiment.yaml"
        self.world, self.over = {"none_m": 2.0}, {}
        self.write(seed=[0, 1], method=["none", "gradient"])

    def describe(self, **values):
        """Write the experiment with another world; ``none_m`` is its total CTE without attack."""
        self.world = values
        self.write()

    def write(self, variants=None, gate=MappingProxyType({}), **over):
        """Write the experiment with other methods and seeds, with more variants beside ``straight``, and with limits of the gate."""
        self.over |= over
        straight = {"over.path": ["loop"], "run_folder": str(self.folder / "run")}
        named = {"variant": {"straight": straight, **(variants or {})}, "victim": ["hardened"], **self.over}
        self._write(
            self.file, run_folder=str(self.folder), gate=None if gate is None else dict(gate), over=named
        )

    def plain(self):
        """An experiment file of the same world without variants."""
        file = self.folder / "plain.experiment.yaml"
        self._write(file)
        return file

    def _write(self, file, **keys):
        world = {"kind": "toy", **self.world}
        data = {"name": "toy", "world": world, "paths": ["loop"], **keys}
        file.write_text(json.dumps(data, indent=1))

    def load(self):
        return toy_cells.load_experiment(self.file, None, [], None)

    @property
    def environment(self):
        root = Path(__file__).parents[3]
        path = os.pathsep.join([str(self.folder), str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {**os.environ, "PYTHONPATH": path}

    def start(self, *arguments):
        code = f"from {toy_cells.MODULE} import install; install(); from nodes.cli.main import main; main()"
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.Popen(
            command,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # the tests may run under nohup
        )

    def call(self, *arguments, timeout_s=100):
        process = self.start(*arguments)
        out, err = process.communicate(timeout=timeout_s)
        assert "Traceback" not in err
        return process.returncode, out, err

    @property
    def calls(self):
        file = self.folder / "calls.txt"
        return file.read_text().splitlines() if file.exists() else []

    def begun(self):
        return [line.split()[1] for line in self.calls if line.startswith("begin")]
