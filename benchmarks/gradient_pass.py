"""What does the gradient cost beyond the rollout? ``python -m benchmarks.gradient_pass RUN_FOLDER``.

In the scene and against the policy of an experiment's run folder, with one dense 64^3 object at the corner. All ways are measured
in one process, in turns, and give the same gradient:

- batched: lambdas first, then the policy's gradient in time batches, on the frames that the rollout kept (ours);
- stepwise: one tick at a time, backwards, on the same kept frames;
- rendering: one tick at a time, backwards, each frame rendered again, as the paper's code does.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, RenderCache, adjoint_gradient, gradient_pass, roll_out
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import make_transform
from benchmarks.attack_lab import lab_problem
from benchmarks.results import record_row

WAYS = ("batched", "stepwise", "rendering")
LINE = "gradient pass"
_SIZE_M = 1.0


def dense_object(T_world_from_object: np.ndarray, resolution: int = 64) -> VoxelGridObject:
    """A soft ball of ``resolution^3`` voxels, each with its own free colour."""
    count = resolution**3
    axis = (np.arange(resolution) + 0.5) / resolution - 0.5
    radius = np.sqrt(sum(part**2 for part in np.meshgrid(axis, axis, axis, indexing="ij")))
    half = 0.5 * _SIZE_M
    return VoxelGridObject(
        np.arange(count, dtype=np.int32).reshape((resolution,) * 3),
        (count, 3),
        np.zeros((0, 3)),
        np.full(3, -half),
        np.full(3, half),
        T_world_from_object,
        density=np.where(radius < 0.45, 60.0, 0.0),
        step_units=_SIZE_M / resolution,
    )


def one_pass(problem: AttackProblem, theta: Tensor, way: str) -> tuple[float, Tensor]:
    """Seconds of the gradient pass alone, and its gradient."""
    cache = RenderCache(problem.cache_bytes if way != "rendering" else 0)
    rollout, memories = roll_out(problem, theta, cache)
    wanted = problem if way == "batched" else replace(problem, time_batch=1)
    began = time.perf_counter()
    result = gradient_pass(wanted, theta, rollout, cache, memories)
    return time.perf_counter() - began, result.gradient


def in_turns(ways: dict[str, Callable[[], tuple[float, Tensor]]], repeats: int) -> dict[str, float]:
    """Median seconds of each way, taken in turns, so that other load on the machine hits all."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    reference: Tensor | None = None
    for _ in range(repeats):
        for name, way in ways.items():
            taken, gradient = way()
            reference = gradient if reference is None else reference
            difference = float((gradient - reference).norm() / reference.norm())
            assert difference < 1e-4, f"{name} gives another gradient: {difference:.1e}"
            seconds[name].append(taken)
    return {name: median(taken) for name, taken in seconds.items()}


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "folder", type=Path, help="run folder of an experiment with scene, policy and calibration"
    )
    parser.add_argument("--steps", type=int, default=60, help="horizon [ticks]")
    parser.add_argument("--resolution", type=int, default=64, help="voxels along an edge of the object")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    arguments = parser.parse_args()
    ball = dense_object(make_transform(np.eye(3), [2.0, -1.9, 0.5]), arguments.resolution)
    problem = lab_problem(arguments.folder, [ball], arguments.steps, time_batch=16, cache_bytes=2**40)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    adjoint_gradient(replace(problem, steps=2), theta)
    seconds = in_turns({way: partial(one_pass, problem, theta, way) for way in WAYS}, arguments.repeats)
    frame_ms = {way: 1e3 * taken / arguments.steps for way, taken in seconds.items()}
    stepwise, rendering = (frame_ms[way] / frame_ms["batched"] for way in WAYS[1:])
    print("\n".join(f"{way}: {taken:.2f} ms a frame" for way, taken in frame_ms.items()))
    print(f"{stepwise:.2f} x against step by step, {rendering:.2f} x against rendering each step again")
    if arguments.trial:
        return
    command = f"python -m benchmarks.gradient_pass {arguments.folder}"
    note = f"T = {arguments.steps}, one {arguments.resolution}^3 object, lab scene, {torch.get_num_threads()} threads"
    ours = frame_ms["batched"]
    record_row(f"{LINE}, per frame", ours, "ms", "<= 10 ms", ours <= 10.0, command, note)
    record_row(
        f"{LINE} against step by step on the same kept frames", stepwise, "x", "printed", None, command, note
    )
    record_row(
        f"{LINE} against rendering each step again", rendering, "x", ">= 5 x", rendering >= 5.0, command, note
    )


if __name__ == "__main__":
    main()
