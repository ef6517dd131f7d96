"""Campaigns over toy cells in real processes: the module of cells is written into a folder that the workers import from."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CELLS = """
import os, time
from pathlib import Path
from types import SimpleNamespace
from nodes.experiment.run.cell_kind import CellKind
from advnerf_core.documents import read_yaml

def _note(folder, text):
    with open(folder.parent.parent / "calls.txt", "a") as file:
        file.write(text + "\\n")

class Toy(CellKind):
    def load(self, file, setting, overrides, folder):
        data = read_yaml(file).data
        for text in overrides:
            key, value = text.split("=")
            data[key] = float(value)
        return SimpleNamespace(folder=Path(folder), data=data)

    def prepare(self, experiment, report):
        experiment.folder.mkdir(parents=True, exist_ok=True)

    def inputs(self, experiment, cell):
        return dict(experiment.data)

    def needed_settings(self, experiment):
        return {"capture": {}, "policy": {}}

    def run(self, experiment, cell, folder, report):
        _note(folder, f"begin {cell.name} {os.environ.get('OMP_NUM_THREADS')}")
        if (folder.parent.parent / "fail").exists() and cell.method == "cem":
            raise RuntimeError("the search came to nothing")
        done = folder / "half"
        try:
            while (folder.parent.parent / "hang").exists() and cell.method == "gradient" and not done.exists():
                (folder / "pid").write_text(str(os.getpid()))
                time.sleep(0.02)
        except BaseException:
            _note(folder, f"closed {cell.name}")
            raise
        _note(folder, f"end {cell.name}")
        factor = {"none": 1.0, "random": 1.1, "cem": 2.0, "gradient": 3.0}[cell.method]
        none = experiment.data["base"] + cell.seed
        drives = {"total_cte_m": [factor * none], "off_track": [cell.method == "gradient"], "none_total_cte_m": [none]}
        found = {"attack_id": None, "surrogate": drives, "deployed": drives, "extra": {}}
        if (folder.parent.parent / "late").exists() and cell.method == "gradient":
            found.pop("deployed")
            return {**found, "not_driven_live": "live0 was spoiled 3 times, at last: late"}
        return found
"""


PICTURES = """
import numpy as np
import torch

from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Line
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.scene.fidelity import PicturePairs
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
    return PicturePairs(of, show(real), show(learned))

class Gated(Toy):
    searches_apart = True

    def judges(self, experiment):
        return True

    def search(self, experiment, cell, folder, report):
        _note(folder, f"search {cell.name}")
        (folder / "searched").touch()

    def policy_of(self, experiment, cell):
        return Reads(), ()

    def held_out(self, experiment, cell):
        with open(experiment.folder / "looked.txt", "a") as file:
            file.write(cell.scenario + "\\n")
        real = np.linspace(0.3, 0.6, 16)
        return _pictures("held-out views", real, real + experiment.data.get("wrong", 0.0))

    def driven(self, experiment, cell, folder, bag=None):
        if experiment.data.get("late") and not folder.with_suffix(".json").exists():
            raise RuntimeFault("expected a live drive, got none")
        real = np.full(16, 0.5)
        return _pictures("driven bag", real, real + experiment.data.get("wrong_drive", 0.0))

    def lacks(self, experiment, cell, folder):
        return "" if (folder / "searched").exists() else "its search"

    def attacked(self, experiment, cell, folder):
        return _pictures("attacked", np.full(16, 0.5 + KEPT * TURN), np.full(16, 0.5 + TURN))

    def loop(self, experiment, cell, folder):
        path = DrivingPath.from_segments((0.0, 0.0, 0.0), [Line(50.0)], closed=False)

        def images(states, attacked):
            return (0.5 - 0.5 * states[:, 1] - states[:, 2] + TURN * attacked)[:, None, None, None]

        return AttackProblem(Reads(), Nothing(), Dubins(1.0, 0.1), path, START, 20), images, START, Horizon(20, 0.1, 0.4)
"""


@pytest.fixture
def gated(here):
    """The bench with cells that also have searches apart, and real and learned pictures."""
    here.code.write_text(CELLS + PICTURES)
    here.kind = "toy_cells.py:Gated"
    here.write("seeds: [0, 1]\nmethods: [gradient, none]\nvictims: [hardened]\n")
    return here


@pytest.fixture
def bench(tmp_path):
    """A folder with a kind of toy cells, an experiment and a campaign of one scenario, two seeds, three methods."""
    return Bench(tmp_path)


@pytest.fixture
def here(bench, monkeypatch):
    """The bench, whose workers find the benchmarks too."""
    monkeypatch.setenv("PYTHONPATH", bench.environment["PYTHONPATH"])
    return bench


class Bench:
    def __init__(self, folder):
        self.folder = folder
        self.cells, self.kind, self.code = folder / "cells", "toy_cells.py:Toy", folder / "toy_cells.py"
        self.code.write_text(CELLS)
        (folder / "toy.experiment.yaml").write_text("base: 2.0\n")
        self.file = folder / "toy.campaign.yaml"
        self.write("seeds: [0, 1]\nmethods: [gradient, none]\nvictims: [hardened]\n")

    def write(self, head, scenarios=""):
        scenario = f"{{kind: '{self.kind}', experiment: toy.experiment.yaml, setting: full, run_folder: {self.folder / 'run'}}}"
        self.file.write_text(
            f"name: toy\nfolder: {self.folder}\n{head}scenarios:\n  straight: {scenario}\n{scenarios}"
        )

    @property
    def environment(self):
        root = Path(__file__).parents[3]  # for what a cell of a test takes from the benchmarks
        path = os.pathsep.join([str(self.folder), str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {**os.environ, "PYTHONPATH": path}

    def start(self, *arguments):
        # The process that plans and waits must not spend two seconds on libraries that only cells and plots need.
        code = "import sys; sys.modules['torch'] = sys.modules['matplotlib'] = None; from nodes.cli.main import main; main()"
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
