"""Pose attacks: the objects' positions, alone or together with their colours, searched through the same adjoint.

The total cross-track error is rough over poses: a gradient step from one pose ends in the next local minimum. So several poses are drawn within
the bounds, each is refined by a few gradient steps, and the best of all evaluations is kept (Abeysirigoonawardena et al. 2023: 5 poses,
10 steps, best of 50). Random poses, and colours, at as many evaluations are the baseline. Both drive past objects with their true edges, as a
deployment shows them; the gradient comes from the same frames, from the same states, with soft edges (`PlacedSensor`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from advnerf_core.adam import Adam
from advnerf_core.attack.adjoint import (
    AdjointResult,
    AttackProblem,
    BlackBoxError,
    RenderCache,
    gradient_pass,
    roll_out,
)
from advnerf_core.attack.methods import FRESH_RUN, SearchRun
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import (
    begin_drawing,
    go_on,
    require_finite,
    search_fingerprint,
    without_gradient,
)
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor


@dataclass(frozen=True)
class MultiStart:
    """The budget of a multi-start search; it evaluates ``samples * steps`` drives.

    Attributes:
        steps: Evaluations of each, including the drawn one.
        pose_rate: Adam's step along a coordinate of the unit box: 0.1 is a twentieth of the bounds.
        colour_rate: Adam's step of the colours before squashing.
    """

    samples: int = 5
    steps: int = 10
    pose_rate: float = 0.1
    colour_rate: float = 0.1

    def __post_init__(self) -> None:
        """Refuse an empty budget."""
        if self.samples < 1 or self.steps < 1 or not (self.pose_rate > 0.0 and self.colour_rate > 0.0):
            raise ValueError(f"expected samples and steps >= 1 and rates > 0, got {self}")

    @property
    def evaluations(self) -> int:
        """Closed-loop evaluations in all."""
        return self.samples * self.steps


def multi_start(
    problem: AttackProblem,
    budget: MultiStart | None = None,
    run: SearchRun = FRESH_RUN,
) -> SearchResult:
    """Draw poses, refine each by projected gradient steps, keep the best evaluation of all.

    Args:
        problem: The attack problem; its sensor must be a `PlacedSensor`.
        run: Seed of the poses and of the colours' starting noise, state file and callback.

    Raises:
        PoseBoundsError: The bounds leave no place beside the lane.
        BlackBoxError: The policy has no gradient.
        NotFiniteError: A loss or gradient is not finite.
        SearchStateError: The state file cannot be used.
    """
    budget = budget or MultiStart()
    sensor = placed_sensor(problem)
    fingerprint = _fingerprint(
        problem,
        "multi-start",
        seed=run.seed,
        steps=budget.steps,
        hash=run.settings_hash,
        rates=[budget.pose_rate, budget.colour_rate],
    )
    state, generator = begin_drawing(run, fingerprint, lambda generator: {})
    climb = _Climb.resumed(sensor, budget, state.tensors)

    def step() -> Evaluation:
        nonlocal climb
        began, number = time.perf_counter(), len(state.history)
        if number % budget.steps == 0:
            climb = _Climb.fresh(sensor, budget, generator)
        theta = climb.theta
        result = _gradient(problem.at_draw(number), theta)
        require_finite(result.loss, result.gradient, number)
        climb.step(result.gradient)
        evaluation = state.record(theta, result.loss, result.totals, time.perf_counter() - began)
        state.tensors = {"generator": generator.get_state(), **climb.tensors()}
        return evaluation

    return go_on(state, run, fingerprint, budget.evaluations, step)


def random_poses(
    problem: AttackProblem,
    evaluations: int = 50,
    sigma: float = 5.0,
    run: SearchRun = FRESH_RUN,
) -> SearchResult:
    """The baseline: poses drawn uniformly from the allowed ones and, if colours are free, colours from ``N(0, sigma^2)``; the best is kept.

    Args:
        problem: The attack problem; its sensor must be a `PlacedSensor`.
        evaluations: Total drives, including a resumed state's; as many as a multi-start's, for a fair comparison.
        sigma: Spread of the colours before squashing.

    Raises:
        PoseBoundsError: The bounds leave no place beside the lane.
        NotFiniteError: A drive is not finite.
        SearchStateError: The state file cannot be used.
    """
    sensor = placed_sensor(problem)
    fingerprint = _fingerprint(problem, "random poses", seed=run.seed, sigma=sigma, hash=run.settings_hash)
    state, generator = begin_drawing(run, fingerprint, lambda generator: {})

    def step() -> Evaluation:
        began = time.perf_counter()
        unit = sensor.space.draw(generator)
        colours = torch.zeros(0, dtype=torch.float64)
        if sensor.free_colours:
            colours = sigma * torch.randn(
                sensor.fixed_colours.shape, generator=generator, dtype=torch.float64
            )
        theta = sensor.join(unit, colours)
        sharp, shown = placed_problem(problem, theta)
        loss_m, totals = without_gradient(sharp, shown, len(state.history))
        state.tensors = {"generator": generator.get_state()}
        return state.record(theta, loss_m, totals, time.perf_counter() - began)

    return go_on(state, run, fingerprint, evaluations, step)


def placed_problem(problem: AttackProblem, theta: Tensor) -> tuple[AttackProblem, Tensor]:
    """The problem with the objects at the places of ``theta``, with true edges, and its theta, which is the colours."""
    surrogate, colours = placed_sensor(problem).sharp(theta)
    return replace(problem, sensor=surrogate), colours


def _gradient(problem: AttackProblem, theta: Tensor) -> AdjointResult:
    """Loss of a drive past the true edges, and the gradient of its frames with soft ones."""
    if not problem.differentiable:
        raise BlackBoxError(
            "expected a policy with a gradient, got one that declares differentiable = False; draw random poses"
        )
    sharp, colours = placed_problem(problem, theta)
    rollout, memories = roll_out(sharp, colours)
    return gradient_pass(problem, theta, rollout, RenderCache(0), memories)


class _Climb:
    """One drawn pose in refinement: coordinates and colours with their Adam, which has no other state."""

    def __init__(
        self,
        sensor: PlacedSensor,
        budget: MultiStart,
        unit: Tensor,
        colours: Tensor,
        moments: Mapping[str, Mapping[str, Tensor]] | None = None,
    ) -> None:
        self._sensor = sensor
        self._parts = {"unit": unit.clone(), "colours": colours.clone()}
        self._rates = {"unit": budget.pose_rate, "colours": budget.colour_rate}
        self._adams = {name: Adam({name: part}, moments) for name, part in self._parts.items()}

    @classmethod
    def fresh(cls, sensor: PlacedSensor, budget: MultiStart, generator: torch.Generator) -> _Climb:
        """A pose drawn at random, with plain colours."""
        theta = sensor.initial_theta(generator)
        return cls(sensor, budget, sensor.unit(theta), theta[sensor.pose_count :])

    @classmethod
    def resumed(cls, sensor: PlacedSensor, budget: MultiStart, tensors: dict[str, Tensor]) -> _Climb:
        """Restore from ``tensors``; meaningless if they are empty."""
        if "unit" not in tensors:
            return cls(sensor, budget, torch.zeros(0, 4), torch.zeros(0))
        moments: dict[str, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            name, _, moment = key.partition(".")
            if moment:
                moments.setdefault(name, {})[moment] = value
        return cls(sensor, budget, tensors["unit"], tensors["colours"], moments)

    @property
    def theta(self) -> Tensor:
        """Current theta."""
        return self._sensor.join(self._parts["unit"], self._parts["colours"])

    def step(self, gradient: Tensor) -> None:
        """One descent step; the pose stays within the allowed ones."""
        unit, before = self._parts["unit"], self._parts["unit"].clone()
        slopes = {
            "unit": self._sensor.unit(gradient),
            "colours": gradient[self._sensor.pose_count :],
        }
        for name, adam in self._adams.items():
            adam.step(self._rates[name], {name: slopes[name]})
        unit.copy_(self._sensor.space.project(unit, before))

    def tensors(self) -> dict[str, Tensor]:
        """Everything that is needed to resume."""
        out: dict[str, Tensor] = {}
        for name, part in self._parts.items():
            out[name] = part.clone()
            moments = self._adams[name].moments[name]
            out |= {f"{name}.{key}": value.clone() for key, value in moments.items()}
        return out


def placed_sensor(problem: AttackProblem) -> PlacedSensor:
    """The sensor of a problem whose objects can be moved, and whose colours have no regulariser."""
    if not isinstance(problem.sensor, PlacedSensor):
        raise TypeError(
            f"expected a problem with a PlacedSensor, got one with a {type(problem.sensor).__name__}"
        )
    if problem.regulariser is not None:
        raise ValueError("expected no regulariser: those of colours do not know placements")
    return problem.sensor


def _fingerprint(problem: AttackProblem, method: str, **settings: Any) -> str:
    """Hash of everything that a pose search depends on, except its length."""
    sensor = placed_sensor(problem)
    keep_out = sensor.space.keep_out
    lane = None if keep_out is None else [keep_out.clearance_m, *(path.to_dict() for path in keep_out.paths)]
    limits: Iterable[Tensor] = (sensor.space.middle, sensor.space.half)
    return search_fingerprint(
        problem,
        sensor.theta_shape,
        method=method,
        lane=lane,
        limits=[part.tolist() for part in limits],
        **settings,
    )
