"""Does memory grow with the horizon? ``python -m benchmarks.adjoint_memory`` (about two minutes on two cores).

Peak resident memory above idle of one loss with its gradient, each horizon in a fresh process, cache off: the adjoint against
plain back-propagation through the unrolled loop (the same loop with camera poses detached, so the same gradient). Idle is after
imports and one evaluation of one step, so that libraries, compiled kernels and thread pools are not counted. The allocator returns
freed blocks at fixed thresholds (see ``_ALLOCATOR``).
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
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient, evaluate
from advnerf_core.files import write_json
from advnerf_core.memory import RETURNS_WHAT_IS_FREED, peak_mib, restart_peak
from benchmarks.results import REPOSITORY, record_row
from tests.support.attack_toy import toy_problem

COMMAND = "python -m benchmarks.adjoint_memory"
METHODS = ("adjoint", "backprop")
WAYS = ("adjoint", "cached", "backprop", "checkpointed")
CACHE_MIB, LEAN_BATCH = 4, 2


class _Render(torch.autograd.Function):
    """A render inside autograd: keeps only what its vjp needs."""

    @staticmethod
    def forward(ctx: Any, theta: Tensor, problem: AttackProblem, states: Tensor) -> Tensor:
        rendered = problem.sensor.sense(states, theta)
        ctx.vjp = rendered.vjp
        return rendered.images

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        return ctx.vjp(grads[0]), None, None


def unrolled_gradient(problem: AttackProblem, theta: Tensor) -> tuple[float, Tensor]:
    """Loss and gradient by back-propagation through the unrolled loop, camera poses detached as they are met."""
    theta = theta.clone().requires_grad_()
    states = [problem.start_states]
    for _ in range(problem.steps):
        images = _Render.apply(theta, problem, states[-1].detach())
        controls = problem.policy(images, problem.goals)
        states.append(problem.dynamics.step(states[-1], controls.to(states[-1].dtype)))
    loss = problem.losses(torch.stack(states)).mean()
    (gradient,) = torch.autograd.grad(loss, theta)
    return float(loss.detach()), gradient


def checkpointed_gradient(problem: AttackProblem, theta: Tensor) -> tuple[float, Tensor]:
    """The same with one checkpoint per step: only states are kept, each step is run again on the way back."""
    theta = theta.clone().requires_grad_()

    def step(theta: Tensor, states: Tensor) -> Tensor:
        images = _Render.apply(theta, problem, states.detach())
        return problem.dynamics.step(states, problem.policy(images, problem.goals).to(states.dtype))

    states = [problem.start_states]
    for _ in range(problem.steps):
        states.append(checkpoint(step, theta, states[-1], use_reentrant=False))
    loss = problem.losses(torch.stack(states)).mean()
    (gradient,) = torch.autograd.grad(loss, theta)
    return float(loss.detach()), gradient


def gradient_by(way: str, problem: AttackProblem, theta: Tensor) -> tuple[float, Tensor]:
    """Loss and gradient by one of `WAYS`; ``cached`` is the adjoint with a budget."""
    if way in ("adjoint", "cached"):
        result = adjoint_gradient(problem, theta)
        return result.loss, result.gradient
    return unrolled_gradient(problem, theta) if way == "backprop" else checkpointed_gradient(problem, theta)


def peak_above_idle_mib(
    method: str, steps: int, time_batch: int = 8, warm: bool = False
) -> tuple[float, float]:
    """Peak [MiB] and time [s] of one gradient in this process, which must be fresh.

    Args:
        method: One of `WAYS`.
        steps: Horizon [ticks].
        time_batch: Frames of one gradient batch of the adjoint.
        warm: Idle is after a gradient over one tick instead of an evaluation: kernels of the backward pass and autograd's
            threads, some tens of MiB that every way needs once, then count as idle.
    """
    cache_bytes = CACHE_MIB * 2**20 if method == "cached" else 0
    problem = toy_problem(
        steps, resolution=16, dtype=torch.float32, cache_bytes=cache_bytes, time_batch=time_batch
    )
    problem = AttackProblem(**{**vars(problem), "start_states": problem.start_states[:1]})
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    evaluate(AttackProblem(**{**vars(problem), "steps": 1}), theta)
    if warm:
        gradient_by(method, AttackProblem(**{**vars(problem), "steps": 1}), theta)
    idle = restart_peak()
    gradient_by(method, problem, theta)
    peak = peak_mib() - idle
    began = time.perf_counter()
    gradient_by(method, problem, theta)
    return peak, time.perf_counter() - began


def measure(horizons: list[int], repeats: int = 3) -> list[dict[str, Any]]:
    """Rows ``{horizon_steps, adjoint_mib, backprop_mib}``; medians over repeats, each in a fresh process."""
    rows = []
    for steps in horizons:
        row: dict[str, Any] = {"horizon_steps": steps}
        for method in METHODS:
            row[f"{method}_mib"] = median(_in_fresh_process(method, steps)["mib"] for _ in range(repeats))
            print(f"T = {steps}: {method} {row[f'{method}_mib']:.1f} MiB above idle", flush=True)
        rows.append(row)
    return rows


def _in_fresh_process(method: str, steps: int, *options: str) -> dict[str, float]:
    command = [
        sys.executable,
        "-m",
        "benchmarks.adjoint_memory",
        "--child",
        method,
        "--horizons",
        str(steps),
        *options,
    ]
    environment = {**os.environ, **RETURNS_WHAT_IS_FREED}
    done = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY, env=environment
    )
    measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return measured


def compare(repeats: int, trial: bool, horizons: tuple[int, int, int] = (60, 200, 600)) -> None:
    """Memory and time at T = 200 against other ways, memory at T = 600 against T = 60."""
    short, middle, long = horizons
    wanted = [("adjoint", short), ("adjoint", long), ("cached", short), ("cached", long)]
    wanted += [(way, middle) for way in WAYS]
    found, runs = {}, {which: list[dict[str, float]]() for which in wanted}
    for _ in range(repeats):  # in turns, so that other load on the machine hits all
        for way, steps in wanted:
            runs[way, steps].append(_in_fresh_process(way, steps, "--warm", "--time-batch", str(LEAN_BATCH)))
    for way, steps in wanted:
        found[way, steps] = {key: median(run[key] for run in runs[way, steps]) for key in ("mib", "seconds")}
        print(
            f"{way}, T = {steps}: {found[way, steps]['mib']:.1f} MiB, {found[way, steps]['seconds']:.2f} s",
            flush=True,
        )
    ours, cached, plain, stepwise = (found[way, middle] for way in WAYS)
    grown = found["adjoint", long]["mib"] / found["adjoint", short]["mib"]
    share, more = ours["mib"] / plain["mib"], cached["mib"] / stepwise["mib"]
    faster = stepwise["seconds"] / cached["seconds"]
    above = found["cached", long]["mib"] - found["adjoint", long]["mib"]
    least = found["adjoint", short]["mib"]
    per_tick_kib = 1024.0 * (found["adjoint", long]["mib"] - least) / (long - short)
    rows = [
        (
            "memory of a gradient, T = 60, against one tick, cache off",
            least,
            "MiB above",
            "<= 8 MiB above",
            least <= 8.0,
            f"one start, time batch {LEAN_BATCH}",
        ),
        (
            "memory at T = 200 against plain back-propagation",
            share,
            "x",
            "<= 0.1 x",
            share <= 0.1,
            f"{ours['mib']:.1f} against {plain['mib']:.1f} MiB, time batch {LEAN_BATCH}, cache off",
        ),
        (
            "against one checkpoint per step, T = 200, time",
            faster,
            "x",
            "> 1 x",
            faster > 1.0,
            f"{CACHE_MIB} MiB cache: {cached['seconds']:.2f} against {stepwise['seconds']:.2f} s at {more:.2f} x memory",
        ),
        (
            "against one checkpoint per step, T = 200, memory",
            more,
            "x",
            "<= 2 x",
            more <= 2.0,
            f"{CACHE_MIB} MiB cache",
        ),
        (
            "memory, T = 600 against T = 60, cache off",
            grown,
            "x",
            "<= 1.05 x",
            grown <= 1.05,
            f"{least:.1f} and {found['adjoint', long]['mib']:.1f} MiB above idle: {per_tick_kib:.1f} KiB for each tick's states, "
            "multipliers and projection onto the path",
        ),
        (
            "memory, T = 600, what the cache adds",
            above,
            "MiB",
            f"<= {CACHE_MIB} MiB, its budget",
            above <= CACHE_MIB,
            "peak above idle with the cache less the one without",
        ),
    ]
    for line, value, unit, target, met, note in rows:
        print(f"{line}: {value:.3f} {unit} (target {target})")
        if not trial:
            record_row(f"adjoint {line}", value, unit, target, met, f"{COMMAND} --compare", note)


def main() -> None:
    """Measure, print, write the JSON and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "--horizons", type=int, nargs="+", default=[25, 50, 100, 200, 400], help="horizons [ticks]"
    )
    parser.add_argument(
        "--output", type=Path, default=REPOSITORY / "docs" / "adjoint_memory.json", help="where rows go"
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="fresh processes per number, of which the median counts"
    )
    parser.add_argument("--no-record", action="store_true", help="leave the ledger alone")
    parser.add_argument(
        "--compare", action="store_true", help="T = 60, 200, 600: also with a cache and checkpoints"
    )
    parser.add_argument(
        "--trial", action="store_true", help="with --compare: short horizons, and nothing is recorded"
    )
    parser.add_argument("--time-batch", type=int, default=8, help=argparse.SUPPRESS)
    parser.add_argument("--warm", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--child", choices=WAYS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        mib, seconds = peak_above_idle_mib(
            arguments.child, arguments.horizons[0], arguments.time_batch, arguments.warm
        )
        print(json.dumps({"mib": mib, "seconds": seconds}))
        return
    if arguments.compare:
        compare(arguments.repeats, arguments.trial, (16, 24, 48) if arguments.trial else (60, 200, 600))
        return
    rows = measure(arguments.horizons, arguments.repeats)
    write_json(arguments.output, rows)
    by_horizon = {row["horizon_steps"]: row for row in rows}
    if not arguments.no_record and {50, 400} <= set(by_horizon):
        short, long = by_horizon[50], by_horizon[400]
        ratio = long["adjoint_mib"] / short["adjoint_mib"]
        note = f"{short['adjoint_mib']:.1f} MiB at T = 50, {long['adjoint_mib']:.1f} MiB at T = 400"
        note += f"; plain back-propagation {short['backprop_mib']:.0f} and {long['backprop_mib']:.0f} MiB; one start, time batch 8"
        record_row(
            "adjoint memory, T = 400 against T = 50", ratio, "x", "<= 1.1 x", ratio <= 1.1, COMMAND, note
        )


if __name__ == "__main__":
    main()
