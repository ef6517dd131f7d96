"""How should the cores share the searches of several seeds? ``python -m benchmarks.seeds_together RUN_FOLDER``.

Gradient searches on the face of a run folder of the room (``make demo``): all seeds as one batch on all cores, one after the other on all
cores, and beside each other with one core each, as the cells of an experiment with ``--jobs`` are. What is timed are the iterations, in
turns.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from advnerf_core.attack.methods import SearchRun

import advnerf_core as advnerf_core  # isort: skip  # before torch, as in the commands
from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.together import gradient_attacks
from benchmarks.results import record_row
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import face_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem

_ITERATIONS, _REPEATS = 6, 3
_BATCH, _IN_A_ROW, _BESIDE = "one batch", "one after the other", "beside each other"


def main() -> None:
    """Time the three ways in turns and record how the batch compares with one core for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument(
        "--worker", nargs="+", metavar="SEED", type=int, help="time these on one core and print it"
    )
    parser.add_argument("--batch", action="store_true", help="with --worker: as one batch")
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(_timed(arguments.run_folder, arguments.worker, arguments.batch)))
        return
    cores = len(os.sched_getaffinity(0))
    seeds = list(range(arguments.seeds))
    ways = {
        _BATCH: ([seeds], True, cores),
        _IN_A_ROW: ([seeds], False, cores),
        _BESIDE: ([seeds[core::cores] for core in range(cores)], False, 1),
    }
    taken: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(_REPEATS):
        for way, (shares, batch, threads) in ways.items():
            taken[way].append(_run(arguments.run_folder, shares, batch, threads) / len(seeds) / _ITERATIONS)
            print(f"{way}: {1e3 * taken[way][-1]:.0f} ms per iteration of one seed", flush=True)
    ms = {way: 1e3 * median(each) for way, each in taken.items()}
    record_row(
        "searches of several seeds: as one batch against one core for each",
        ms[_BESIDE] / ms[_BATCH],
        "x the speed",
        "the default is the faster way",
        ms[_BESIDE] <= ms[_BATCH],
        f"python -m benchmarks.seeds_together {arguments.run_folder}",
        f"{len(seeds)} seeds, {cores} cores, ms per iteration of one seed: "
        + ", ".join(f"{way} {value:.0f}" for way, value in ms.items())
        + "; cells of an experiment are searched beside each other",
    )


def _run(folder: Path, shares: list[list[int]], batch: bool, threads: int) -> float:
    """Seconds until the slowest of the processes is done with its iterations."""
    number = {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.seeds_together", str(folder), "--worker", *map(str, share)]
            + ["--batch"] * batch,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **number},
        )
        for share in shares
    ]
    printed = [process.communicate()[0] for process in processes]
    if any(process.returncode for process in processes):
        raise SystemExit("a worker failed; what it said stands above")
    return max(float(json.loads(text)) for text in printed)


def _timed(folder: Path, seeds: list[int], batch: bool) -> float:
    """Seconds of the iterations of these seeds in this process."""
    experiment = Experiment.resolved_in(folder.resolve())
    space, policy = face_space(experiment), load_victim(experiment, HARDENED)
    (scenario,) = experiment.config.paths

    def problem(seed: int) -> AttackProblem:
        return attack_problem(experiment, space, policy, scenario, seed)

    gradient_attack(problem(seeds[0]), 1)  # kernels are loaded, pages are touched
    problems = [problem(seed) for seed in seeds]
    began = time.perf_counter()
    if batch:
        gradient_attacks(problems, seeds, _ITERATIONS)
    else:
        for seed, each in zip(seeds, problems, strict=True):
            gradient_attack(each, _ITERATIONS, run=SearchRun(seed))
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
