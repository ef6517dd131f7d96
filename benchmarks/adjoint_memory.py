"""Does memory grow with the horizon? ``python -m benchmarks.adjoint_memory`` (about two minutes on two cores).

Peak resident memory above idle of one loss with its gradient, each horizon in a fresh process, cache off: the adjoint against
plain back-propagation through the unrolled loop (the same loop with camera poses detached, so the same gradient). Idle is after
imports and one evaluation of one step, so that libraries, compiled kernels and thread pools are not counted.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient, evaluate
from advnerf_core.files import write_atomically
from advnerf_core.memory import peak_mib, restart_peak
from benchmarks.attack_toy import toy_problem
from benchmarks.results import REPOSITORY, record_row

COMMAND = "python -m benchmarks.adjoint_memory"
METHODS = ("adjoint", "backprop")


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
    states, loss = problem.start_states, torch.zeros((), dtype=problem.start_states.dtype)
    for _ in range(problem.steps):
        images = _Render.apply(theta, problem, states.detach())
        states = problem.dynamics.step(states, problem.policy(images, problem.goals).to(states.dtype))
        loss = loss + problem.cost(states).mean()
    (gradient,) = torch.autograd.grad(loss, theta)
    return float(loss.detach()), gradient


def peak_above_idle_mib(method: str, steps: int) -> float:
    """Measure in this process, which must be fresh."""
    problem = toy_problem(steps, resolution=16, dtype=torch.float32, cache_bytes=0)
    problem = AttackProblem(**{**vars(problem), "start_states": problem.start_states[:1]})
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    evaluate(AttackProblem(**{**vars(problem), "steps": 1}), theta)
    idle = restart_peak()
    _ = adjoint_gradient(problem, theta) if method == "adjoint" else unrolled_gradient(problem, theta)
    return peak_mib() - idle


def measure(horizons: list[int], repeats: int = 3) -> list[dict[str, Any]]:
    """Rows ``{horizon_steps, adjoint_mib, backprop_mib}``; medians over repeats, each in a fresh process."""
    rows = []
    for steps in horizons:
        row: dict[str, Any] = {"horizon_steps": steps}
        for method in METHODS:
            row[f"{method}_mib"] = median(_in_fresh_process(method, steps) for _ in range(repeats))
            print(f"T = {steps}: {method} {row[f'{method}_mib']:.1f} MiB above idle", flush=True)
        rows.append(row)
    return rows


def _in_fresh_process(method: str, steps: int) -> float:
    command = [sys.executable, "-m", "benchmarks.adjoint_memory", "--child", method, "--horizons", str(steps)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY)
    return float(json.loads(done.stdout.splitlines()[-1])["mib"])


def main() -> None:
    """Measure, print, write the JSON and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--horizons", type=int, nargs="+", default=[25, 50, 100, 200, 400], help="horizons [ticks]")
    parser.add_argument(
        "--output", type=Path, default=REPOSITORY / "docs" / "adjoint_memory.json", help="where rows go"
    )
    parser.add_argument("--repeats", type=int, default=3, help="fresh processes per number, of which the median counts")
    parser.add_argument("--no-record", action="store_true", help="leave the ledger alone")
    parser.add_argument("--child", choices=METHODS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps({"mib": peak_above_idle_mib(arguments.child, arguments.horizons[0])}))
        return
    rows = measure(arguments.horizons, arguments.repeats)
    write_atomically(arguments.output, json.dumps(rows, indent=1) + "\n")
    by_horizon = {row["horizon_steps"]: row for row in rows}
    if not arguments.no_record and {50, 400} <= set(by_horizon):
        short, long = by_horizon[50], by_horizon[400]
        ratio = long["adjoint_mib"] / short["adjoint_mib"]
        note = f"{short['adjoint_mib']:.1f} MiB at T = 50, {long['adjoint_mib']:.1f} MiB at T = 400"
        note += f"; plain back-propagation {short['backprop_mib']:.0f} and {long['backprop_mib']:.0f} MiB; one start, time batch 8"
        record_row("#2 adjoint memory, T = 400 against T = 50", ratio, "x", "<= 1.1 x", ratio <= 1.1, COMMAND, note)


if __name__ == "__main__":
    main()
