"""The gradient attack for several seeds at once: their drives are one batch, their textures and optimisers stay separate.

Adam works on each number by itself, so Adam on stacked textures is as many independent Adams. Frames are rendered, and the policy is
evaluated, for all seeds in one call, which suits an accelerator and saves fixed costs on a CPU. Sums over a larger batch
round differently, so a seed searched together with others ends near, not at, the bits that it reaches alone.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, Sensor, Totals, adjoint_gradient
from advnerf_core.attack.methods import GRADIENT_RATE
from advnerf_core.attack.search.descent import Descent
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import (
    SearchState,
    SearchStateError,
    evaluation_from_json,
    require_slope,
    search_fingerprint,
)
from advnerf_core.errors import NotFiniteError
from advnerf_core.files import read_tensors, write_atomically
from advnerf_core.scene.device_surrogate import DeviceSurrogate
from advnerf_core.scene.many_textures import ManyTextures
from advnerf_core.scene.surrogate import Surrogate

_FORMAT = "advnerf-searches-1"

OnSeedEvaluation = Callable[[int, Evaluation], None]
"""Called with the number of the seed in the list, and its evaluation."""


@dataclass(frozen=True, eq=False)
class _Batch:
    """Problems of several seeds as one.

    Attributes:
        problem: All starts of all seeds, without the regulariser.
        starts: Start poses of each.
    """

    problem: AttackProblem
    each: tuple[AttackProblem, ...]
    starts: int

    @classmethod
    def of(cls, problems: Sequence[AttackProblem]) -> _Batch:
        first, starts = problems[0], len(problems[0].start_states)
        if any(len(p.start_states) != starts or p.steps != first.steps for p in problems):
            raise ValueError(
                "expected problems that differ in seed and start poses only, got other numbers of starts or steps"
            )
        if not first.policy.stateless:
            raise ValueError(
                "expected a stateless policy; search the seeds of one with memory one after the other"
            )
        goals = None if first.goals is None else torch.cat([p.goals for p in problems if p.goals is not None])
        together = replace(
            first,
            sensor=_many(first.sensor, len(problems), starts),
            goals=goals,
            regulariser=None,
            start_states=torch.cat([p.start_states for p in problems]),
        )
        return cls(together, tuple(problems), starts)


def _many(sensor: Sensor, count: int, starts: int) -> Sensor:
    """The sensor for several textures at once."""
    if isinstance(sensor, Surrogate):
        return ManyTextures(sensor, count, starts)
    if isinstance(sensor, DeviceSurrogate):
        return sensor.many(count, starts)
    raise TypeError(f"expected problems with a Surrogate as sensor, got {type(sensor).__name__}")


def gradient_attacks(
    problems: Sequence[AttackProblem],
    seeds: Sequence[int],
    iterations: int = 50,
    learning_rate: float = GRADIENT_RATE,
    state_path: Path | None = None,
    on_evaluation: OnSeedEvaluation | None = None,
    settings_hash: str = "",
) -> list[SearchResult]:
    """``gradient_attack`` for several seeds in one batch.

    Args:
        problems: One for each seed; they differ in start poses and disturbances only. The disturbances' seed is the first problem's,
            with different numbers for every drive.
        iterations: Total evaluations of each seed, including a resumed state's.
        state_path: Common state file, written after every iteration; if it exists, the attack resumes from it.
        on_evaluation: Called after every iteration, once for each seed.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.

    Raises:
        NotFiniteError: A loss or gradient is not finite.
        ZeroGradientError: The first gradient of a seed is zero.
        SearchStateError: The state file cannot be used.
    """
    if iterations < 1 or not problems or len(problems) != len(seeds):
        raise ValueError(
            f"expected iterations >= 1 and a problem for each seed, got {iterations} and {len(problems)} for {len(seeds)} seeds"
        )
    batch = _Batch.of(problems)
    fingerprint = search_fingerprint(
        batch.problem,
        batch.problem.sensor.theta_shape,
        method="gradients",
        seeds=list(seeds),
        learning_rate=learning_rate,
        hash=settings_hash,
    )
    states, tensors = _begin(batch, seeds, state_path, fingerprint)
    descent = Descent(tensors, learning_rate)
    while len(states[0].history) < iterations:
        began, draw = time.perf_counter(), len(states[0].history)
        loss, totals, gradient = _gradients(batch, descent.theta, draw)
        for theta, slope in zip(descent.theta, gradient, strict=True):
            require_slope(theta, slope, draw)
        evaluated = descent.theta.clone()  # before Adam changes it in place
        descent.step(gradient)
        spent_s = (time.perf_counter() - began) / len(seeds)
        made = [state.record(evaluated[k], loss[k], totals[k], spent_s) for k, state in enumerate(states)]
        if state_path is not None:
            _save(state_path, fingerprint, states, descent.tensors)
        if on_evaluation is not None:
            for k, evaluation in enumerate(made):
                on_evaluation(k, evaluation)
    return [state.result() for state in states]


def _gradients(batch: _Batch, theta: Tensor, draw: int) -> tuple[list[float], list[Totals], Tensor]:
    """Losses, totals and gradients ``[K, ...]`` of the seeds, each as if it were alone."""
    result = adjoint_gradient(batch.problem.at_draw(draw), theta)
    count = len(batch.each)
    gradient = result.gradient * count  # the loss is the mean over all seeds' drives
    losses, totals = [], []
    for k, problem in enumerate(batch.each):
        rows = slice(k * batch.starts, (k + 1) * batch.starts)
        totals.append(result.totals.rows(rows))
        losses.append(float(totals[-1].losses.mean()))
        if problem.regulariser is not None:
            extra, slope = problem.regulariser(theta[k])
            losses[-1] += extra
            gradient[k] += slope
    if not (all(math.isfinite(loss) for loss in losses) and bool(torch.isfinite(gradient).all())):
        raise NotFiniteError(
            f"expected finite losses and gradients at iteration {draw}, got losses {losses}; the policy's own gradient is finite: check the gradients of the objects and the scene for NaN"
        )
    return losses, totals, gradient


def _begin(
    batch: _Batch, seeds: Sequence[int], path: Path | None, fingerprint: str
) -> tuple[list[SearchState], dict[str, Tensor]]:
    if path is not None and path.exists():
        return _load(path, fingerprint, len(seeds))
    surrogate = batch.each[0].sensor
    theta = torch.stack([surrogate.initial_theta(torch.Generator().manual_seed(seed)) for seed in seeds])
    return [SearchState({}) for _ in seeds], {"theta": theta}


def _save(path: Path, fingerprint: str, states: Sequence[SearchState], tensors: dict[str, Tensor]) -> None:
    best = torch.stack([state.best_theta for state in states if state.best_theta is not None])
    histories = [[asdict(evaluation) for evaluation in state.history] for state in states]
    header = {"format": _FORMAT, "fingerprint": fingerprint, "histories": json.dumps(histories)}
    write_atomically(
        path, save({**{k: v.contiguous() for k, v in tensors.items()}, "best_theta": best}, metadata=header)
    )


def _load(path: Path, fingerprint: str, count: int) -> tuple[list[SearchState], dict[str, Tensor]]:
    try:
        header, tensors = read_tensors(path, "torch")
        best = tensors.pop("best_theta")
        histories = [[evaluation_from_json(each) for each in one] for one in json.loads(header["histories"])]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise SearchStateError(f"cannot resume from {path} ({error!r}); delete it to start afresh") from error
    if header.get("format") != _FORMAT or header.get("fingerprint") != fingerprint or len(histories) != count:
        raise SearchStateError(
            f"{path} belongs to a search with other settings; delete it, or use another folder"
        )
    states = [SearchState({}, theta, history) for theta, history in zip(best, histories, strict=True)]
    return states, tensors
