"""The attack on a policy that can only be queried: the adjoint, with the one factor that a black box hides replaced by an estimate.

Of the adjoint's ``dJ/dtheta = sum_t (do_t/dtheta)^T (dpi/do)^T s_t``, ``s_t = (df/du)^T lambda_{t+1}``, the attacker knows everything but
``dpi/do``: states and controls are the victim's own, lambdas follow from them and the car's model. Two ways to replace it:

- ``distilled``: ``dpi/do`` of a student that was trained on the victim's answers (`distil.Student`), at the frames that the *victim* visited.
- ``guided``: along a unit direction ``d`` of theta the victim's own slope is measured by an antithetic pair of queries about the visited
  frames, ``d . dJ/dtheta = sum_t s_t (pi(o_t(theta + h d)) - pi(o_t(theta - h d))) / 2h``. The directions are the student's gradient, the
  running mean of earlier estimates, and random coarse textures, made orthonormal; the estimate is the projection of the true gradient
  onto their span. As the student's gradient lies in the span, the estimate is never further from the truth than a rescaled student,
  and a student that is wrong about a sign is corrected. This is the search subspace of Guided Evolution Strategies (Maheswaranathan et al. 2019,
  "Guided evolutionary strategies: augmenting random search with surrogate gradients") with orthogonal directions (Choromanski et al. 2018,
  "Structured Evolution with Compact Architectures for Scalable Policy Optimization").

Both drive by the victim's controls, never by the student's: the student need only be right about slopes where the victim drives, and
errors of its steering do not add up over a drive. Pairs of queries use frozen frames: closed-loop differences, as in plain evolution,
pay for the chaos of the loop with variance, and every one needs new backgrounds. The pairs are also the student's next lesson, so it is
refreshed on the attack's own trajectory at no cost. All queries of the victim are counted (`query_count`).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AdjointResult, gradient_pass
from advnerf_core.attack.methods import FRESH_RUN, SearchRun, SearchSettings, StudentOptions
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.distil import (
    ArchitectureStudent,
    Distillation,
    Lessons,
    Student,
    StudentFactory,
    to_bytes,
)
from advnerf_core.attack.search.population import Coarse
from advnerf_core.attack.search.query_count import CountedPolicy, calls_per_evaluation
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import (
    SearchState,
    begin_drawing,
    go_on,
    require_finite,
    search_fingerprint,
)
from advnerf_core.attack.search.visited import Visited, VisitedDrive
from advnerf_core.errors import AdvnerfError

Method = Literal["distilled", "guided"]
_USUAL: dict[Method, tuple[float, int]] = {"guided": (0.3, 3), "distilled": (0.1, 1)}
_ADAM = (0.9, 0.999, 1e-8)
# A probe changes no single value of theta by more than this many times its root mean square.
_STEEPEST = 5.0


class BudgetError(AdvnerfError, ValueError):
    """Too few policy calls for even one step of a search."""


@dataclass(frozen=True)
class BlackBoxSearch:
    """Settings of an attack on a policy without a gradient.

    Attributes:
        probes: Antithetic pairs of textures queried at every visited frame, after every drive. ``distilled`` uses them as lessons only.
        probe_sigma: Root mean square of a probe's change of theta.
        cells: Cells along an edge of the random textures; see `Coarse`.
    """

    method: Method = "guided"
    learning_rate: float = 0.3
    probes: int = 3
    probe_sigma: float = 0.1
    cells: int = 8
    distillation: Distillation = field(default_factory=Distillation)
    student: StudentFactory = field(default_factory=ArchitectureStudent)

    def __post_init__(self) -> None:
        if self.probes < 1 or self.learning_rate <= 0.0 or self.probe_sigma <= 0.0:
            raise ValueError(f"expected probes >= 1, learning_rate > 0 and probe_sigma > 0, got {self}")

    @classmethod
    def usual(
        cls, method: Method, learning_rate: float | None = None, probes: int | None = None, **others: Any
    ) -> BlackBoxSearch:
        """A method with its default rate and probes, where none are given.

        A budget buys ``guided`` few steps, so each must be long, and queries are worth less than steps; see docs/methods.md.
        """
        rate, pairs = _USUAL[method]
        return cls(method, learning_rate or rate, probes or pairs, **others)

    def first_calls(self) -> int:
        """Policy calls of the first lesson."""
        return 2 * self.distillation.warm_pairs

    @property
    def drives_per_step(self) -> int:
        """Policy calls of a step, in drives: the drive itself, and the queries at each of its frames."""
        return 1 + 2 * self.probes

    def step_calls(self, problem: AttackProblem) -> int:
        """Policy calls of one drive and its queries."""
        return calls_per_evaluation(problem) * self.drives_per_step

    def evaluations(self, problem: AttackProblem, calls: int) -> int:
        """Drives, each with its gradient, that a budget of policy calls allows.

        Raises:
            BudgetError: The budget allows not even one.
        """
        least = self.first_calls() + self.step_calls(problem)
        if calls < least:
            raise BudgetError(
                f"expected at least {least} policy calls ({self.first_calls()} for the first lesson, {self.step_calls(problem)} for a "
                f"step), got {calls}; allow more evaluations, or fewer warm_pairs and probes"
            )
        return (calls - self.first_calls()) // self.step_calls(problem)

    def settings(self) -> str:
        """Settings that must be the same when a search is resumed."""
        student = self.student
        name = student.name if isinstance(student, ArchitectureStudent) else type(student).__name__
        return repr(self).replace(repr(student), name)


def black_box_attack(
    problem: AttackProblem,
    search: BlackBoxSearch,
    calls: int,
    run: SearchRun = FRESH_RUN,
) -> SearchResult:
    """Maximise the objective by queries alone.

    Args:
        problem: The attack problem; its policy is only queried for steering, even if it has a gradient.
        calls: Total policy calls (images), including a resumed state's; never exceeded.
        run: Seed of the start, the student and the probes, state file and callback; a search resumes from its state file to the bit.

    Raises:
        BudgetError: ``calls`` do not allow one step.
        VictimError: The policy has a memory.
    """
    evaluations = search.evaluations(problem, calls)
    victim = CountedPolicy(problem.policy)
    problem = replace(problem, policy=victim)
    shape = tuple(problem.sensor.theta_shape)
    fingerprint = search_fingerprint(
        problem, shape, method=search.settings(), seed=run.seed, hash=run.settings_hash
    )
    state, generator = begin_drawing(run, fingerprint, lambda generator: _fresh(problem, generator))
    victim.calls = int(state.tensors["calls"])
    loop = _Loop(problem, search, state, generator, run.seed)

    def step() -> Evaluation:
        evaluation = loop.step()
        state.tensors["calls"] = torch.tensor(victim.calls)
        return evaluation

    return go_on(state, run, fingerprint, evaluations, step)


def search_as(
    method: Method, problem: AttackProblem, settings: SearchSettings, run: SearchRun
) -> SearchResult:
    """`black_box_attack` with the settings of a method; it raises the same errors."""
    return black_box_attack(problem, _asked(method, settings), _policy_calls(problem, settings), run)


def planned_evaluations(method: Method, problem: AttackProblem, settings: SearchSettings) -> int:
    """Drives that the budget allows a method.

    Raises:
        BudgetError: The budget allows not even one.
    """
    return _asked(method, settings).evaluations(problem, _policy_calls(problem, settings))


def _asked(method: Method, settings: SearchSettings) -> BlackBoxSearch:
    lessons = Distillation() if settings.warm_pairs is None else Distillation(warm_pairs=settings.warm_pairs)
    options = settings.options or StudentOptions()
    return BlackBoxSearch.usual(
        method,
        settings.learning_rate,
        settings.probes,
        cells=settings.cells,
        distillation=lessons,
        student=ArchitectureStudent(options.architecture),
    )


def _policy_calls(problem: AttackProblem, settings: SearchSettings) -> int:
    """The budget in policy calls, the same for all methods: evaluations x starts x ticks."""
    return settings.evaluations * calls_per_evaluation(problem)


def _fresh(problem: AttackProblem, generator: torch.Generator) -> dict[str, Tensor]:
    theta = problem.sensor.initial_theta(generator)
    moments = {"m": torch.zeros_like(theta), "v": torch.zeros_like(theta)}
    return {"theta": theta, **moments, "calls": torch.tensor(0)}


class _Loop:
    """One step: drive, query, learn, estimate, move."""

    def __init__(
        self,
        problem: AttackProblem,
        search: BlackBoxSearch,
        state: SearchState,
        generator: torch.Generator,
        seed: int,
    ) -> None:
        self._problem, self._search, self._state = problem, search, state
        self._generator, self._seed = generator, seed
        self._coarse = Coarse(tuple(problem.sensor.theta_shape), search.cells)
        self._student: Student | None = None
        if state.history:
            self._student = Student.from_tensors(state.tensors, search.distillation, search.student)

    def step(self) -> Evaluation:
        began, known = time.perf_counter(), self._state.tensors
        theta, number = known["theta"], len(self._state.history)
        problem = self._problem.at_draw(number)
        driven = VisitedDrive(problem, theta)
        if self._student is None:
            lessons = _first_lessons(
                problem, driven, theta, self._coarse, self._search.distillation, self._generator
            )
            self._student = Student(lessons, self._search.distillation, self._seed, self._search.student)
            self._student.begin(self._generator)
        blind = replace(problem, policy=self._student, regulariser=None)
        result = gradient_pass(blind, theta, driven.rollout, driven.cache)
        directions = self._directions(result.gradient, known["m"])
        slopes = self._ask(problem, driven, theta, directions, result)
        gradient = result.gradient
        if self._search.method == "guided":
            gradient = (slopes @ directions).reshape(theta.shape).to(theta.dtype)
        loss_m = result.loss
        if problem.regulariser is not None:
            extra, slope = problem.regulariser(theta)
            loss_m, gradient = loss_m + extra, gradient + slope
        require_finite(loss_m, gradient, number)
        self._student.go_on(self._generator)
        evaluation = self._state.record(theta, loss_m, result.totals, time.perf_counter() - began)
        moved = _adam_step(theta, gradient, known["m"], known["v"], number + 1, self._search.learning_rate)
        kept = {"calls": known["calls"], "generator": self._generator.get_state()}
        self._state.tensors = {**moved, **kept, **self._student.tensors()}
        return evaluation

    def _directions(self, gradient: Tensor, mean: Tensor) -> Tensor:
        """Orthonormal directions ``[probes, theta]`` in float64."""
        count = min(self._search.probes, gradient.numel())
        drawn = [
            self._coarse.expand(torch.randn(self._coarse.shape, generator=self._generator))
            for _ in range(count)
        ]
        if self._search.method == "distilled":
            rows = drawn
        else:
            rows = [hint for hint in (gradient, mean) if bool(hint.any())] + drawn
        stacked = torch.stack([row.reshape(-1).double() for row in rows[:count]])
        Q, _ = torch.linalg.qr((stacked / stacked.norm(dim=1, keepdim=True)).T)
        return Q.T.contiguous()

    def _ask(
        self,
        problem: AttackProblem,
        driven: VisitedDrive,
        theta: Tensor,
        directions: Tensor,
        result: AdjointResult,
    ) -> Tensor:
        """The victim's slopes ``[probes]`` of the loss along directions; its answers become a lesson."""
        assert self._student is not None
        weights = _control_slopes(problem, result)
        settings = self._search.distillation
        share = min(weights.numel(), math.ceil(settings.fresh_pairs / len(directions)))
        slopes = torch.zeros(len(directions), dtype=torch.float64)
        goals = _goals(problem, weights.shape[0])
        # As many queries as announced, even if theta has fewer values than there are probes.
        for k in range(self._search.probes):
            direction = directions[k % len(directions)]
            size = self._search.probe_sigma * min(
                len(direction) ** 0.5, _STEEPEST / float(direction.abs().max())
            )
            move = (size * direction).reshape(theta.shape).to(theta.dtype)
            images = [driven.images(theta + sign * move).flatten(0, 1) for sign in (1.0, -1.0)]
            answers = torch.stack([problem.policy(each, goals) for each in images], dim=1)
            difference = (answers[:, 0] - answers[:, 1]).double().reshape(weights.shape)
            slopes[k % len(directions)] = (weights * difference).sum() / (2.0 * size)
            chosen = torch.randperm(weights.numel(), generator=self._generator)[:share]
            pairs = torch.stack([to_bytes(each[chosen]) for each in images], dim=1)
            kept_goals = torch.zeros(len(chosen), 0) if goals is None else goals[chosen]
            lesson = Lessons(pairs, kept_goals, answers[chosen])
            self._student.lessons.add(lesson, settings.memory_pairs, self._generator)
        return slopes


def _first_lessons(
    problem: AttackProblem,
    driven: VisitedDrive,
    theta: Tensor,
    coarse: Coarse,
    settings: Distillation,
    generator: torch.Generator,
) -> Lessons:
    """Places around the first drive, each in two random textures around the first one."""
    places = driven.rollout.states[:-1].flatten(0, 1)
    chosen = torch.randint(len(places), (settings.warm_pairs,), generator=generator)
    states = places[chosen].clone()
    noise = torch.randn(len(states), 3, generator=generator).to(states.dtype)
    states[:, :3] += settings.place_sigma * noise
    all_goals = _goals(problem, problem.steps)
    goals = torch.zeros(len(places), 0) if all_goals is None else all_goals
    images, answers = [], []
    for state, goal in zip(states, goals[chosen], strict=True):
        frame = Visited(problem, (0,), state[None])
        pair = []
        for _ in range(2):
            spread = settings.texture_sigma * float(torch.rand((), generator=generator))
            texture = coarse.expand(torch.randn(coarse.shape, generator=generator)).to(theta.dtype)
            pair.append(frame.render(theta + spread * texture).images)
        both = torch.cat(pair)
        answers.append(problem.policy(both, None if all_goals is None else goal.expand(2, -1)))
        images.append(to_bytes(both))
    return Lessons(torch.stack(images), goals[chosen], torch.stack(answers))


def _goals(problem: AttackProblem, ticks: int) -> Tensor | None:
    return None if problem.goals is None else problem.goals.repeat(ticks, 1)


def _control_slopes(problem: AttackProblem, result: AdjointResult) -> Tensor:
    """``(df/du)^T lambda_{t+1}``, the derivative of the loss with respect to each control of the drive, ``[T, B]`` float64."""
    states, controls = result.rollout.states, result.rollout.controls
    slopes = [
        (problem.dynamics.jacobians(states[t], controls[t])[1] * result.lambdas[t + 1]).sum(-1)
        for t in range(len(controls))
    ]
    return torch.stack(slopes).double()


def _adam_step(
    theta: Tensor, gradient: Tensor, m: Tensor, v: Tensor, steps: int, learning_rate: float
) -> dict[str, Tensor]:
    first, second, tiny = _ADAM
    m, v = torch.lerp(gradient, m, first), torch.lerp(gradient**2, v, second)
    step = (m / (1 - first**steps)) / ((v / (1 - second**steps)).sqrt() + tiny)
    return {"theta": theta - learning_rate * step, "m": m, "v": v}
