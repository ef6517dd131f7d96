"""Peak memory of one adjoint gradient against the horizon, in this experiment's own scene, with an empty cache.

``python -m nodes.experiment.steps.memory RUN_FOLDER TICKS...`` prints each horizon and its peak above idle [MiB]. The first gradient of a
process also brings libraries and buffers into memory, so that one is computed before the horizons.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient
from advnerf_core.attack.spaces.space import Space
from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.memory import RETURNS_WHAT_IS_FREED, peak_mib, restart_peak
from advnerf_core.run_module import module_command
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import face_space
from nodes.experiment.show.given import victim_without_gradient
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem
from nodes.runtime.progress import Report

HORIZONS = (50, 400)
_BEFORE_TICKS = 16


def measure(experiment: Experiment, folder: Path, report: Report) -> dict[int, float]:
    """Measure the missing horizons, and give all of them with their peaks [MiB]; stored in ``memory.json`` so that an interrupted report resumes. Empty for a victim without a gradient."""
    if victim_without_gradient(experiment):
        return {}
    kept = folder / "memory.json"
    rows: dict[str, float] = read_json(kept) if kept.exists() else {}
    missing = [ticks for ticks in HORIZONS if str(ticks) not in rows]
    report(0.0, "memory of the adjoint")
    if missing:
        for ticks, mib in in_a_child("nodes.experiment.steps.memory", experiment.folder, missing):
            rows[str(ticks)] = mib
            write_atomically(kept, json.dumps(rows) + "\n")
            report(len(rows) / len(HORIZONS), f"memory of the adjoint at T = {ticks}")
    return {int(ticks): mib for ticks, mib in rows.items()}


def in_a_child(module: str, path: Path, horizons: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Horizons and their peaks [MiB] as a module's command measures them, in a process that returns freed memory.

    Raises:
        subprocess.CalledProcessError: The process failed.
    """
    command = module_command(module, str(path), *map(str, horizons))
    environment = {**os.environ, **RETURNS_WHAT_IS_FREED}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        for line in child.stdout:
            ticks, mib = line.split()
            yield int(ticks), float(mib)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command)


def print_peaks(problem: AttackProblem, space: Space, horizons: Sequence[int]) -> None:
    """Print each horizon and the peak above idle of one gradient of the first start over it [MiB]."""
    goals = None if problem.goals is None else problem.goals[:1]
    problem = dataclasses.replace(problem, start_states=problem.start_states[:1], goals=goals, cache_bytes=0)
    theta = space.surrogate.initial_theta(torch.Generator().manual_seed(0))
    adjoint_gradient(dataclasses.replace(problem, steps=min(_BEFORE_TICKS, *horizons)), theta)
    for ticks in horizons:
        idle_mib = restart_peak()
        adjoint_gradient(dataclasses.replace(problem, steps=ticks), theta)
        print(ticks, peak_mib() - idle_mib, flush=True)


def main() -> None:
    """Measure horizons of a run folder."""
    experiment = Experiment.resolved_in(Path(sys.argv[1]))
    space = face_space(experiment, ideal=True)
    policy, scenario = load_victim(experiment, experiment.config.main_victim), experiment.config.paths[0]
    problem = attack_problem(experiment, space, policy, scenario, experiment.config.seeds[0])
    print_peaks(problem, space, [int(ticks) for ticks in sys.argv[2:]])


if __name__ == "__main__":
    main()
