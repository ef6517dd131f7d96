"""Peak memory of one gradient of a request against the horizon, in a process of its own that returns freed memory, with an empty cache.

``python -m nodes.experiment.node.memory REQUEST_FILE TICKS...`` prints each horizon and its peak above idle [MiB]. The first gradient of a
process also brings libraries and buffers into memory, so that one is computed before the horizons.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.memory import RETURNS_WHAT_IS_FREED, peak_mib, restart_peak
from advnerf_core.run_module import module_command
from nodes.experiment.node.job import REQUEST
from nodes.experiment.node.prepare import load_request, prepare, request_text
from nodes.experiment.show.context import Experiment

_BEFORE_TICKS = 16


def measured_mib(request: Experiment, horizons: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Horizons [ticks] and their peaks above idle [MiB], one after the other.

    Raises:
        subprocess.CalledProcessError: The process failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / REQUEST
        file.write_text(request_text(request))
        command = module_command("nodes.experiment.node.memory", str(file), *map(str, horizons))
        environment = {**os.environ, **RETURNS_WHAT_IS_FREED}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as child:
            assert child.stdout is not None
            for line in child.stdout:
                ticks, mib = line.split()
                yield int(ticks), float(mib)
        if child.returncode:
            raise subprocess.CalledProcessError(child.returncode, command)


def main() -> None:
    """Measure horizons of a request: the gradient of its first start."""
    file, *horizons = sys.argv[1:]
    prepared = prepare(load_request(Path(file), folder=Path(file).parent))
    goals = None if prepared.problem.goals is None else prepared.problem.goals[:1]
    first = prepared.problem.start_states[:1]
    problem = dataclasses.replace(prepared.problem, start_states=first, goals=goals, cache_bytes=0)
    theta = prepared.space.surrogate.initial_theta(torch.Generator().manual_seed(0))
    ticks = [int(each) for each in horizons]
    adjoint_gradient(dataclasses.replace(problem, steps=min(_BEFORE_TICKS, *ticks)), theta)
    for steps in ticks:
        idle_mib = restart_peak()
        adjoint_gradient(dataclasses.replace(problem, steps=steps), theta)
        print(steps, peak_mib() - idle_mib, flush=True)


if __name__ == "__main__":
    main()
