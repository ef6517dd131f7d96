"""Campaigns over toy cells in real processes: the module of cells is written into a folder that the workers import from."""

import os
import subprocess
import sys
import textwrap

import pytest

CELLS = """
import json, os, time
from pathlib import Path
from types import SimpleNamespace
from nodes.runtime.config import read_yaml

def load_experiment(file, setting, overrides, folder):
    data = read_yaml(file).data
    for text in overrides:
        key, value = text.split("=")
        data[key] = float(value)
    return SimpleNamespace(folder=Path(folder), data=data)

def prepare(experiment, report):
    experiment.folder.mkdir(parents=True, exist_ok=True)

def cell_inputs(experiment, scenario, victim, method, seed):
    return dict(experiment.data)

def _note(folder, text):
    with open(folder.parent.parent / "calls.txt", "a") as file:
        file.write(text + "\\n")

def run_cell(experiment, scenario, victim, method, seed, folder, report):
    name = f"{scenario}_{victim}_{method}_{seed}"
    _note(folder, f"begin {name} {os.environ['OMP_NUM_THREADS']}")
    if (folder.parent.parent / "fail").exists() and method == "cem":
        raise RuntimeError("the search came to nothing")
    done = folder / "half"
    try:
        while (folder.parent.parent / "hang").exists() and method == "gradient" and not done.exists():
            (folder / "pid").write_text(str(os.getpid()))
            time.sleep(0.02)
    except BaseException:
        _note(folder, f"closed {name}")
        raise
    _note(folder, f"end {name}")
    factor = {"none": 1.0, "random": 1.1, "cem": 2.0, "gradient": 3.0}[method]
    none = experiment.data["base"] + seed
    drives = {"total_cte_m": [factor * none], "off_track": [method == "gradient"], "none_total_cte_m": [none]}
    return {"attack_id": None, "surrogate": drives, "deployed": drives, "extra": {}}
"""


@pytest.fixture
def bench(tmp_path):
    """A folder with a module of toy cells, an experiment and a campaign of one scenario, two seeds, three methods."""
    return Bench(tmp_path)


class Bench:
    def __init__(self, folder):
        self.folder = folder
        self.cells = folder / "cells"
        (folder / "toy_cells.py").write_text(textwrap.dedent(CELLS))
        (folder / "toy.experiment.yaml").write_text("base: 2.0\n")
        self.file = folder / "toy.campaign.yaml"
        self.write("seeds: [0, 1]\nmethods: [gradient, none]\nvictims: [hardened]\n")

    def write(self, head, scenarios=""):
        scenario = (
            f"{{kind: toy_cells, experiment: toy.experiment.yaml, setting: full, run_folder: {self.folder / 'run'}}}"
        )
        self.file.write_text(f"name: toy\nfolder: {self.folder}\n{head}scenarios:\n  straight: {scenario}\n{scenarios}")

    @property
    def environment(self):
        path = os.pathsep.join([str(self.folder), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {**os.environ, "PYTHONPATH": path}

    def start(self, *arguments):
        command = [sys.executable, "-m", "nodes.cli", "campaign", *arguments]
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
