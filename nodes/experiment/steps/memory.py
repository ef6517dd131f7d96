"""Peak memory of one adjoint gradient against the horizon, in this experiment's own scene, with an empty cache.

Each horizon is measured in a fresh process: ``python -m nodes.experiment.steps.memory RUN_FOLDER TICKS`` prints the peak above idle.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import torch

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient, evaluate
from advnerf_core.attack.spaces.space import Space
from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.memory import RETURNS_WHAT_IS_FREED, peak_mib, restart_peak
from advnerf_core.report.data import MemoryRow
from advnerf_core.run_module import module_command
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import face_space
from nodes.experiment.show.given import victim_without_gradient
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem
from nodes.runtime.progress import Report

HORIZONS = (50, 200, 400)


def measure(experiment: Experiment, folder: Path, report: Report) -> tuple[MemoryRow, ...]:
    """Measure the missing horizons; stored in ``memory.json`` so that an interrupted report resumes. Empty for a victim without a gradient."""
    if victim_without_gradient(experiment):
        return ()
    kept = folder / "memory.json"
    rows: dict[str, float] = read_json(kept) if kept.exists() else {}
    for index, ticks in enumerate(HORIZONS):
        report(index / len(HORIZONS), f"memory of the adjoint at T = {ticks}")
        if str(ticks) not in rows:
            command = module_command("nodes.experiment.steps.memory", str(experiment.folder), str(ticks))
            environment = {**os.environ, **RETURNS_WHAT_IS_FREED}
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
            rows[str(ticks)] = float(done.stdout.split()[-1])
            write_atomically(kept, json.dumps(rows) + "\n")
    return tuple(MemoryRow(int(ticks), mib) for ticks, mib in rows.items())


def peak_above_idle_mib(experiment: Experiment, ticks: int) -> float:
    """Peak above idle of one gradient over ``ticks`` ticks [MiB]; the process must be fresh."""
    space = face_space(experiment, ideal=True)
    policy, scenario = load_victim(experiment, experiment.config.main_victim), experiment.config.paths[0]
    problem = attack_problem(experiment, space, policy, scenario, experiment.config.seeds[0])
    return gradient_peak_mib(problem, space, ticks)


def gradient_peak_mib(problem: AttackProblem, space: Space, ticks: int, cache_mib: float = 0.0) -> float:
    """Peak above idle of one gradient of the first start over ``ticks`` ticks [MiB]; the process must be fresh."""
    goals = None if problem.goals is None else problem.goals[:1]
    one, cache_bytes = problem.start_states[:1], int(cache_mib * 2**20)
    problem = dataclasses.replace(
        problem, start_states=one, goals=goals, steps=ticks, cache_bytes=cache_bytes
    )
    theta = space.surrogate.initial_theta(torch.Generator().manual_seed(0))
    # Libraries, compiled kernels and thread pools are idle memory.
    evaluate(dataclasses.replace(problem, steps=1), theta)
    idle_mib = restart_peak()
    adjoint_gradient(problem, theta)
    return peak_mib() - idle_mib


def main() -> None:
    """Measure one horizon of a run folder."""
    folder, ticks = Path(sys.argv[1]), int(sys.argv[2])
    print(peak_above_idle_mib(Experiment.resolved_in(folder), ticks))


if __name__ == "__main__":
    main()
