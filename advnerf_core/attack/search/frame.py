"""The method ``frame``: a gradient attack on frames, without the car's dynamics.

It uses the fixed frames of the drive without an attack. Theta follows the gradient of the steering's deviation there, summed over
the ticks; how deviations accumulate in a drive, and where they lead, is left out. So the difference to ``gradient`` is what
the dynamics are worth. Attacks of this kind are known for steering networks (Zhou et al. 2020, "DeepBillboard: systematic
physical-world testing of autonomous driving systems").
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import evaluate, roll_out
from advnerf_core.attack.image_gradients import require_finite_gradient, with_history
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.gradient import Slope, climb
from advnerf_core.attack.search.query_count import VictimError
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.search.search import gradient_step
from advnerf_core.attack.search.visited import Visited
from advnerf_core.errors import NotFiniteError

_NAME = "frame"
# Distance in theta at which both sides are tried before one is chosen: strong colours, as far as `random` spreads them.
_LOOK = 5.0


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`.

    Each evaluation is one closed-loop drive, which only ranks the thetas, and one gradient on the frames. The drive without an attack,
    and the renders that choose a side, are not counted.

    Raises:
        BlackBoxError: The policy has no gradient.
        NoColoursError: Theta is not colours.
        VictimError: The policy has a memory, so that a frame alone does not determine its steering.
    """
    problem.require_gradient()
    if not problem.policy.stateless:
        raise VictimError(
            f"expected a stateless policy for the method {_NAME}, got one with memory: a frame alone does not tell its steering; "
            "use the method gradient"
        )
    frames = CleanFrames(problem, problem.coloured(_NAME).plain_theta())
    side = better_side(frames, problem.sensor.initial_theta(torch.Generator().manual_seed(run.seed)))

    def slope_of(drawn: AttackProblem, theta: Tensor) -> Slope:
        totals = evaluate(drawn, theta)[1]
        loss_m, gradient = float(totals.losses.mean()), -side * frames.deviation(theta, drawn.draw)[1]
        if drawn.regulariser is not None:
            extra, slope = drawn.regulariser(theta)
            loss_m, gradient = loss_m + extra, gradient + slope
        return Slope(loss_m, totals, gradient)

    return climb(problem, slope_of, settings.evaluations, gradient_step(problem, settings), run, method=_NAME)


class CleanFrames:
    """The frames of the drive without an attack, rendered with any theta.

    Data that does not depend on theta is kept as long as it fits into the problem's cache.

    Args:
        problem: The attack problem; its policy is stateless.
        plain_theta: The colours without an attack.
    """

    def __init__(self, problem: AttackProblem, plain_theta: Tensor) -> None:
        self._problem = problem
        self.rollout, _ = roll_out(problem.undisturbed(), plain_theta)
        self._kept: list[Visited] = []
        if problem.disturbances is None:
            self._kept = list(self._visited(problem))

    def deviation(self, theta: Tensor, draw: int = 0) -> tuple[float, Tensor]:
        """Deviation of the steering to the left, relative to the drive without an attack.

        Args:
            theta: Colours, ``theta_shape``.

        Returns:
            Sum over ticks and mean over starts of steering minus clean steering [rad], and its gradient, ``theta_shape``.
        """
        total, gradient = 0.0, torch.zeros_like(theta)
        for steering, seen in self._steering(theta, draw):
            total += steering
            gradient += seen
        clean = self.rollout.controls
        return (total - float(clean.sum())) / clean.shape[1], gradient / clean.shape[1]

    def _steering(self, theta: Tensor, draw: int) -> Iterator[tuple[float, Tensor]]:
        """Sum of the steering of each batch of ticks, and its gradient."""
        problem = self._problem
        batches = self._kept or self._visited(replace(problem, draw=draw))
        for visited in batches:
            rendered = visited.render(theta)
            ticks = len(rendered.images) // len(problem.start_states)
            goals = None if problem.goals is None else problem.goals.repeat(ticks, 1)
            with torch.enable_grad():
                images = rendered.images.detach().requires_grad_()
                steering = with_history(problem.policy(images, goals)).sum()
                (slope,) = torch.autograd.grad(steering, images)
            require_finite_gradient(slope)
            yield float(steering.detach()), rendered.vjp(slope)

    def _visited(self, problem: AttackProblem) -> Iterator[Visited]:
        used_bytes = 0
        for first in range(0, problem.steps, problem.time_batch):
            ticks = range(first, min(first + problem.time_batch, problem.steps))
            visited = Visited(problem, ticks, self.rollout.states[first : ticks.stop].flatten(0, 1))
            used_bytes += visited.nbytes
            if used_bytes > problem.cache_bytes:
                visited.forget()
            yield visited


def better_side(frames: CleanFrames, theta: Tensor) -> int:
    """The side on which a long step of signs from ``theta`` makes the frames deviate more: 1 is left, -1 is right."""
    _, gradient = frames.deviation(theta)
    step = _LOOK * gradient.sign()
    left, right = frames.deviation(theta + step)[0], -frames.deviation(theta - step)[0]
    if not torch.isfinite(torch.tensor([left, right])).all():
        raise NotFiniteError(
            f"expected finite steering on the frames without an attack, got deviations {left} and {right}; check the policy for NaN"
        )
    return 1 if left >= right else -1
