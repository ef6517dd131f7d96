"""Campaigns over toy cells in real processes."""

import os
import subprocess
import sys
from pathlib import Path

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
    """A folder with an experiment of toy cells and a campaign of one scenario, two seeds, two methods."""
    toy_cells.put_over(monkeypatch, MODULES)
    monkeypatch.setattr(worker, "module_command", toy_cells.command)
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
        self.describe(none_m=2.0)
        self.file = folder / "toy.campaign.yaml"
        self.write("seeds: [0, 1]\nmethods: [gradient, none]\nvictims: [hardened]\n")

    def describe(self, **values):
        """Write the experiment; ``none_m`` is its total CTE without attack."""
        lines = [f"{name}: {value}\n" for name, value in values.items()]
        (self.folder / "toy.experiment.yaml").write_text("settings: {full: {}}\n" + "".join(lines))

    def write(self, head, scenarios=""):
        scenario = f"{{experiment: toy.experiment.yaml, setting: full, run_folder: {self.folder / 'run'}}}"
        self.file.write_text(
            f"name: toy\nfolder: {self.folder}\n{head}scenarios:\n  straight: {scenario}\n{scenarios}"
        )

    @property
    def environment(self):
        root = Path(__file__).parents[3]
        path = os.pathsep.join([str(self.folder), str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {**os.environ, "PYTHONPATH": path}

    def start(self, *arguments):
        code = f"from {toy_cells.MODULE} import install; install(); from nodes.cli.main import main; main()"
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.Popen(
            command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
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
