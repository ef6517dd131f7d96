"""How much faster is a search on a GPU? ``python -m benchmarks.gpu RUN_FOLDER``.

Ticks of the surrogate with a hydrant of 64^3 (scene, object and policy, 200 x 66), one drive and sixteen drives at once, and an iteration of an
attack on it, on the processor and on the GPU in turns. Without a GPU the rows say that nothing was measured.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import advnerf_core as advnerf_core  # isort: skip  # before torch, as in the commands
import numpy as np
import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.attack.device import use_device
from advnerf_core.attack.on_device import on_chosen_device
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.scene.agreement import search_device
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.results import record_row
from benchmarks.ticks import hydrants
from benchmarks.timing import seconds_in_turns
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import face_space
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem

_STEPS, _REPEATS, _DRIVES = 40, 5, (1, 16)
_ITERATION = "attack iteration of 40 ticks on a GPU, against the processor"


def main() -> None:
    """Measure and record the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_folder", type=Path)
    arguments = parser.parse_args()
    command = f"python -m benchmarks.gpu {arguments.run_folder}"
    if not torch.cuda.is_available():
        for line in (*map(_line, _DRIVES), _ITERATION):
            record_row(
                line,
                "not measured",
                "",
                "none",
                None,
                command,
                "no GPU was there; the same code is compared with the kernels on the processor",
            )
        return
    use_device("cuda")
    experiment = Experiment.resolved_in(arguments.run_folder.resolve())
    policy, scenario = load_victim(experiment, HARDENED), experiment.config.paths[0]
    background = load_background(experiment)
    surrogate = Surrogate(background, experiment.view.pinhole, experiment.mount, hydrants(1))
    space = face_space(experiment, background)
    here = replace(attack_problem(experiment, space, policy, scenario, 0), sensor=surrogate, steps=_STEPS)
    there, theta = on_chosen_device(here), surrogate.plain_theta()
    device = search_device()
    name = torch.cuda.get_device_name() + " refused" * (device is None)
    path = experiment.paths[scenario]
    states = torch.tensor(np.array([path.pose_at(float(s)) for s in np.linspace(0.0, 3.0, 32)]))
    for count in _DRIVES:
        ways = {
            where: partial(_drive, problem, states, count, theta)
            for where, problem in (("cpu", here), ("gpu", there))
        }
        _record(_line(count), seconds_in_turns(ways, _REPEATS), len(states) / count, command, name)
    both: dict[str, Callable[[], object]] = {
        where: partial(adjoint_gradient, problem, theta) for where, problem in (("cpu", here), ("gpu", there))
    }
    _record(_ITERATION, seconds_in_turns(both, _REPEATS), 1.0, command, name)


def _line(drives: int) -> str:
    return f"surrogate tick on a GPU, {drives} drive(s) at once, against the processor"


@torch.no_grad()
def _drive(problem: AttackProblem, states: torch.Tensor, count: int, theta: torch.Tensor) -> None:
    for batch in states.split(count):
        problem.policy(problem.sensor.sense(batch, theta).images)


def _record(line: str, seconds: dict[str, float], ticks: float, command: str, name: str) -> None:
    note = ", ".join(f"{where} {1e3 * each / ticks:.2f} ms" for where, each in seconds.items())
    record_row(line, seconds["cpu"] / seconds["gpu"], "x the speed", "none", None, command, f"{name}: {note}")


if __name__ == "__main__":
    main()
