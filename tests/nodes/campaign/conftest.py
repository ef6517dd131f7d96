"""Campaigns over toy cells in real processes: the module of cells is written into a folder that the workers import from."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

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


FIDELITY = """
import numpy as np
import torch

from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Line, Path
from advnerf_core.scene.fidelity import Pictures
from nodes.runtime.errors import RuntimeFault

# Real pictures keep half of what the attack does on learned ones.
TURN, KEPT = 0.2, 0.5
START = torch.tensor([[0.0, 0.3, 0.0]], dtype=torch.float64)

class Reads:
    stateless = True

    def __call__(self, images, goals=None):
        return images[:, 0, 0, 0] - 0.5

class Nothing:
    theta_shape = (1,)

def _pictures(of, real, learned):
    grain = np.random.default_rng(0).uniform(0.0, 0.1, (len(real), 66, 200, 3))  # as SSIM of flat pictures says nothing
    grain[:, 0, 0] = 0.0
    show = lambda values: np.round(255 * (grain + np.asarray(values)[:, None, None, None])).astype(np.uint8)
    return Pictures(of, show(real), show(learned))

def policy_of(experiment, victim, scenario):
    return Reads(), ()

def held_out(experiment, scenario):
    with open(experiment.folder / "looked.txt", "a") as file:
        file.write(scenario + "\\n")
    real = np.linspace(0.3, 0.6, 16)
    return _pictures("held-out views", real, real + experiment.data.get("wrong", 0.0))

def driven(experiment, scenario, victim, seed, folder, bag=None):
    if experiment.data.get("late") and not folder.with_suffix(".json").exists():
        raise RuntimeFault("expected a live drive, got none")
    real = np.full(16, 0.5)
    return _pictures("driven bag", real, real + experiment.data.get("wrong_drive", 0.0))

def lacks(experiment, scenario, victim, method, seed, folder):
    return "" if (folder / "searched").exists() else "its search"

def attacked(experiment, scenario, victim, method, seed, folder):
    return _pictures("attacked", np.full(16, 0.5 + KEPT * TURN), np.full(16, 0.5 + TURN))

def loop(experiment, scenario, victim, method, seed, folder):
    path = Path.from_segments((0.0, 0.0, 0.0), [Line(50.0)], closed=False)

    def images(states, with_attack):
        return (0.5 - 0.5 * states[:, 1] - states[:, 2] + TURN * with_attack)[:, None, None, None]

    return AttackProblem(Reads(), Nothing(), Dubins(1.0, 0.1), path, START, 20), images, START, Horizon(20, 0.1, 0.4)
"""
SEARCH = """
def search_cell(experiment, scenario, victim, method, seed, folder, report):
    _note(folder, f"search {scenario}_{victim}_{method}_{seed}")
    (folder / "searched").touch()
"""


@pytest.fixture
def gated(bench, monkeypatch):
    """The bench with cells in a package that also has searches and a module of fidelity, importable here as on the command line."""
    package = bench.folder / "toyland"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "cells.py").write_text(CELLS + SEARCH)
    (package / "fidelity.py").write_text(FIDELITY)
    bench.kind = "toyland.cells"
    bench.write("seeds: [0, 1]\nmethods: [gradient, none]\nvictims: [hardened]\n")
    monkeypatch.syspath_prepend(str(bench.folder))
    monkeypatch.setenv("PYTHONPATH", bench.environment["PYTHONPATH"])
    yield bench
    for name in [name for name in sys.modules if name.partition(".")[0] == "toyland"]:
        del sys.modules[name]


@pytest.fixture
def bench(tmp_path):
    """A folder with a module of toy cells, an experiment and a campaign of one scenario, two seeds, three methods."""
    return Bench(tmp_path)


@pytest.fixture
def here(bench, monkeypatch):
    """The bench, with its module of cells importable in this process too, as the command line has it."""
    monkeypatch.syspath_prepend(str(bench.folder))
    monkeypatch.setenv("PYTHONPATH", bench.environment["PYTHONPATH"])
    yield bench
    sys.modules.pop("toy_cells", None)


class Bench:
    def __init__(self, folder):
        self.folder = folder
        self.cells, self.kind = folder / "cells", "toy_cells"
        (folder / "toy_cells.py").write_text(textwrap.dedent(CELLS))
        (folder / "toy.experiment.yaml").write_text("base: 2.0\n")
        self.file = folder / "toy.campaign.yaml"
        self.write("seeds: [0, 1]\nmethods: [gradient, none]\nvictims: [hardened]\n")

    def write(self, head, scenarios=""):
        scenario = f"{{kind: {self.kind}, experiment: toy.experiment.yaml, setting: full, run_folder: {self.folder / 'run'}}}"
        self.file.write_text(
            f"name: toy\nfolder: {self.folder}\n{head}scenarios:\n  straight: {scenario}\n{scenarios}"
        )

    @property
    def environment(self):
        root = Path(__file__).parents[3]  # for what a cell of a test takes from the benchmarks
        path = os.pathsep.join([str(self.folder), str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
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
