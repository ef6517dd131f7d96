"""What does training of the demo's victims cost, against an earlier commit? ``python -m benchmarks.victim_training RUN --before WORKTREE``.

RUN holds the demo with a baked scene: ``advnerf experiment run launch/room.experiment.yaml --setting demo --folder RUN --until bake``.
WORKTREE is made by ``git worktree add WORKTREE af4e442``. Both train in turns, each in a process of its own, from the same scene: frames,
steps, checkpoints and errors, all of the stage ``policy``. Then each victim drives a lap of the room without an attack.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch

from advnerf_core.documents import parse_json, read_json
from advnerf_core.policies.number_type import layer_type
from advnerf_core.policies.policy_file import load_policy
from benchmarks import train_victims
from benchmarks.results import record_row
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.drives import deployed_drives
from nodes.experiment.show.faces import PaintedScene
from nodes.experiment.steps.run import load_experiment

COMMAND = "python -m benchmarks.victim_training RUN --before WORKTREE"
TARGET = 0.5
_ROOT = Path(__file__).parents[1]
_STAGES = ("capture", "scene", "bake", "object")
# Compiles the kernels, which is not counted.
_SHORT = [
    f"--set=policy.{each}"
    for each in (
        "deployed_stills=32",
        "surrogate_stills=32",
        "drive_steps=2",
        "first_steps=2",
        "round_steps=2",
        "naive_steps=2",
    )
]
_FILES = {"hardened": "policy.safetensors", "naive": "naive.safetensors"}


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder of the demo, up to its baked scene")
    parser.add_argument("--before", type=Path, required=True, help="worktree of the earlier commit")
    parser.add_argument("--turns", type=int, default=1, help="trainings of each, in turns; the best counts")
    parser.add_argument(
        "--number-type", choices=["float32", "bfloat16"], help="of this build; by default the machine's"
    )
    parser.add_argument(
        "--set", action="append", default=[], help="change of the demo's settings, for a trial"
    )
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    arguments = parser.parse_args()
    roots = {"before": arguments.before.resolve(), "now": _ROOT}
    costs: dict[str, list[dict[str, float]]] = {name: [] for name in roots}
    errors: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, root in roots.items():
            train(root, arguments.run.resolve(), Path(folder) / name, _SHORT)
        for turn in range(arguments.turns):
            for name, root in roots.items():
                out = Path(folder) / f"{name}{turn}"
                options = [f"--set={each}" for each in arguments.set]
                if name == "now" and arguments.number_type:
                    options.append(f"--number-type={arguments.number_type}")
                costs[name].append(train(root, arguments.run.resolve(), out, options))
                errors[name] = quality(arguments.run.resolve(), out / "policy")
                print(f"{name}: {costs[name][-1]}, {errors[name]}", flush=True)
    note = (
        "; ".join(f"{name} {_text(errors[name])}" for name in roots)
        + f"; {_type_text(arguments.number_type)}"
    )
    for what, unit in (("user_s", "user core-seconds"), ("wall_s", "wall time")):
        best = {name: min(each[what] for each in costs[name]) for name in roots}
        ratio = best["now"] / best["before"]
        said = (
            f"{best['now']:.0f} s against {best['before']:.0f} s, best of {arguments.turns} in turns; {note}"
        )
        print(f"{unit}: {ratio:.2f}: {said}")
        if not (arguments.trial or arguments.set):
            line = f"training the demo's victims, {unit} against af4e442" + _suffix(arguments.number_type)
            record_row(line, ratio, "", f"<= {TARGET}", ratio <= TARGET, COMMAND, said)


def train(root: Path, run: Path, folder: Path, options: Sequence[str]) -> dict[str, float]:
    """User core-seconds and seconds of the stage with the code of a worktree, in a new run folder with the stages of a run."""
    folder.mkdir()
    for stage in _STAGES:
        (folder / stage).symlink_to(run / stage)
    command = [sys.executable, "-c", Path(train_victims.__file__).read_text(), str(folder), *options]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    cost: dict[str, float] = parse_json(done.stdout.splitlines()[-1], "the training process")
    return cost


def quality(run: Path, trained: Path) -> dict[str, Any]:
    """Held-out error [rad] of both victims, and their mean |CTE| [m] in a lap without an attack."""
    summary = read_json(trained / "policy.json")
    lap = load_experiment(_ROOT / train_victims.LAUNCH_FILE, "demo", [], run)
    path = lap.paths["track"]
    ticks = round(path.length_m / (lap.car.speed_mps * lap.config.dt_s))
    lap = load_experiment(lap.file, "demo", [f"horizon={ticks}"], run)
    ctes = {name: own_cte_m(lap, trained / file) for name, file in _FILES.items()}
    return {
        "error_rad": {"hardened": summary["validation_mae"], "naive": summary["naive_validation_mae"]},
        "cte_m": ctes,
    }


def own_cte_m(experiment: Experiment, file: Path) -> float:
    """Mean |CTE| [m] of a policy from the start of the drive on, without an attack."""
    start = torch.tensor([experiment.references["track"].drive_start], dtype=torch.float64)
    with experiment.open_world() as world:
        dressed = PaintedScene(experiment, world)
        drives = deployed_drives(experiment, dressed, load_policy(file).policy, "track", start, None)
    return median(drive.metrics.mean_cte_m for drive in drives)


def _text(found: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {1e3 * found['error_rad'][name]:.1f} mrad held out and {100 * found['cte_m'][name]:.1f} cm |CTE|"
        for name in _FILES
    )


def _type_text(number_type: str | None) -> str:
    return f"numbers: {number_type or str(layer_type()).removeprefix('torch.')}"


def _suffix(number_type: str | None) -> str:
    return f", {number_type}" if number_type else ""


if __name__ == "__main__":
    main()
