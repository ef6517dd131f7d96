"""The discrete adjoint of a closed loop whose camera poses are detached.

The loop is ``o_t = h(stop_gradient(x_t), theta)``, ``u_t = pi(o_t)``, ``x_{t+1} = f(x_t, u_t)`` with loss
``J(x_0, ..., x_T)`` of an objective (`advnerf_core.attack.objective`), averaged over start poses. Its adjoint (Lagrange multipliers of the
dynamics) is::

    lambda_T = dJ/dx_T,   lambda_t = dJ/dx_t + (df/dx)^T lambda_{t+1}
    dJ/dtheta = sum_{t=0..T-1} (do_t/dtheta)^T (dpi/do)^T (df/du)^T lambda_{t+1}

This is the exact derivative of the rollout with every camera pose frozen at its nominal value while the states still move. It
is *not* the derivative of the true closed loop, in which a changed state also changes the image.

For a stateless policy all lambdas follow from states and controls without rendering, and the terms of the sum are independent:
they are evaluated in time batches of fixed size. Renders of the forward pass are kept up to a byte budget, the rest is
rendered again, so memory does not grow with the horizon. A policy with memory falls back to one step at a time, backwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advnerf_core.attack.image_gradients import (
    image_gradients,
    require_finite_gradient,
    with_history,
)
from advnerf_core.attack.objective import loss_slopes
from advnerf_core.attack.problem import (
    AttackProblem,
    BlackBoxError,
    Sensor,
    Totals,
    require_finite_parameters,
)
from advnerf_core.driving.dynamics import Dynamics
from advnerf_core.driving.rollout import Remembering, Rollout, drive
from advnerf_core.scene.surrogate import Rendered

__all__ = [
    "AdjointResult", "AttackProblem", "BlackBoxError", "RenderCache", "Sensor", "Totals", "adjoint_gradient", "adjoint_states",
    "evaluate", "gradient_pass", "roll_out",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class AdjointResult:
    """A loss with its gradient.

    Attributes:
        loss: Mean of the objective's losses over the starts, and the regulariser's part; lower is a stronger attack.
        gradient: dJ/dtheta with camera poses frozen, ``theta_shape``.
        lambdas: Adjoint states ``[T + 1, B, n]``; ``lambdas[0]`` is the derivative with respect to the start.
        rollout: The nominal trajectory.
        totals: Losses, values and total CTE per start.
        rerendered: Steps that the cache could not keep and that were rendered twice.
    """

    loss: float
    gradient: Tensor
    lambdas: Tensor
    rollout: Rollout
    totals: Totals
    rerendered: int


@dataclass
class RenderCache:
    """Renders of a rollout by step, up to a byte budget; the rest is dropped."""

    budget_bytes: int
    used_bytes: int = 0
    _kept: dict[int, Rendered] = field(default_factory=dict)

    def offer(self, step: int, rendered: Rendered) -> None:
        """Keep a render if it fits into the budget."""
        if self.used_bytes + rendered.nbytes <= self.budget_bytes:
            self._kept[step] = rendered
            self.used_bytes += rendered.nbytes

    def take(self, step: int) -> Rendered | None:
        """Remove and return a render; None if it was not kept."""
        rendered = self._kept.pop(step, None)
        if rendered is not None:
            self.used_bytes -= rendered.nbytes
        return rendered


def roll_out(
    problem: AttackProblem, theta: Tensor, cache: RenderCache | None = None, keep_memories: bool = True
) -> tuple[Rollout, list[Tensor]]:
    """Drive the closed loop for ``theta``; also the memories ``[T + 1]`` of a policy that has one (else empty), for a gradient."""
    require_finite_parameters(theta)
    step = 0

    def observe(states: Tensor) -> Tensor:
        nonlocal step
        rendered = problem.sense((step,), states, theta)
        if cache is not None:
            cache.offer(step, rendered)
        step += 1
        return rendered.images

    policy = problem.policy
    if not policy.stateless:
        policy = Remembering(policy, len(problem.start_states), keep_memories)
    rollout = drive(policy, observe, problem.dynamics, problem.start_states, problem.steps, problem.goals)
    return rollout, policy.memories if isinstance(policy, Remembering) else []


def evaluate(problem: AttackProblem, theta: Tensor) -> tuple[Rollout, Totals]:
    """One closed-loop drive with parameters ``theta`` (``theta_shape``), and its totals; no gradient."""
    rollout, _ = roll_out(problem, theta, keep_memories=False)
    return rollout, problem.totals(rollout.states)


def adjoint_gradient(problem: AttackProblem, theta: Tensor) -> AdjointResult:
    """Loss and gradient of one rollout; the module's docstring says what the gradient is and is not.

    Args:
        problem: The attack problem.
        theta: Parameters of the objects, ``theta_shape``.

    Raises:
        BlackBoxError: The policy declares that it has no gradient.
    """
    problem.require_gradient()
    theta = theta.detach()
    cache = RenderCache(problem.cache_bytes)
    rollout, memories = roll_out(problem, theta, cache)
    return gradient_pass(problem, theta, rollout, cache, memories)


def gradient_pass(
    problem: AttackProblem,
    theta: Tensor,
    rollout: Rollout,
    cache: RenderCache,
    memories: Sequence[Tensor] = (),
) -> AdjointResult:
    """The gradient of a rollout that was driven with ``theta``.

    Args:
        problem: The attack problem.
        theta: Parameters of the rollout, without history.
        rollout: Nominal trajectory.
        cache: Renders kept from the rollout; it is emptied.
        memories: Memories ``[T + 1]`` of a policy that has one.
    """
    loss, state_slopes = loss_slopes(problem.objective, problem.judged(rollout.states))
    lambdas, control_slopes = adjoint_states(problem.dynamics, rollout, state_slopes)
    rerendered = 0
    gradient = torch.zeros_like(theta)
    batches = _batched_terms if problem.policy.stateless else _sequential_terms
    for term, again in batches(problem, theta, rollout, control_slopes, cache, memories):
        gradient += term
        rerendered += again
    if problem.regulariser is not None:
        extra, slope = problem.regulariser(theta)
        loss, gradient = loss + extra, gradient + slope
    return AdjointResult(loss, gradient, lambdas, rollout, problem.totals(rollout.states), rerendered)


def adjoint_states(dynamics: Dynamics, rollout: Rollout, state_slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Lambdas from states and controls alone, without a render.

    Args:
        dynamics: Vehicle model.
        rollout: Nominal trajectory.
        state_slopes: ``dJ/dx_t`` holding all other states, ``[T + 1, B, n]``.

    Returns:
        Lambdas ``[T + 1, B, n]`` and ``(df/du)^T lambda_{t+1}``, the gradient with respect to each control, ``[T, B]``.
    """
    lambdas = state_slopes.clone()
    control_slopes = torch.empty_like(rollout.controls)
    for t in range(len(rollout.controls) - 1, -1, -1):
        df_dx, df_du = dynamics.jacobians(rollout.states[t], rollout.controls[t])
        control_slopes[t] = (df_du * lambdas[t + 1]).sum(-1)
        lambdas[t] += torch.einsum("bij,bi->bj", df_dx, lambdas[t + 1])
    return lambdas, control_slopes


_Terms = Iterator[tuple[Tensor, int]]


def _batched_terms(
    problem: AttackProblem,
    theta: Tensor,
    rollout: Rollout,
    control_slopes: Tensor,
    cache: RenderCache,
    memories: Sequence[Tensor],
) -> _Terms:
    """Gradient terms of a stateless policy, one time batch after the other, each with its number of repeated renders."""
    del memories  # a stateless policy has none
    steps, starts = control_slopes.shape
    for first in range(0, steps, problem.time_batch):
        last = min(first + problem.time_batch, steps)
        pieces, again = _renders(problem, theta, rollout, range(first, last), cache)
        goals = None if problem.goals is None else problem.goals.repeat(last - first, 1)
        images = torch.cat([piece.images for piece in pieces])
        slopes = control_slopes[first:last].reshape(-1)
        grad_images = image_gradients(problem.policy, images, goals, slopes, problem.reduced)
        del images
        sizes = [len(piece.images) for piece in pieces]
        assert sum(sizes) == (last - first) * starts
        # One sum, not a stack: a dense object's gradient is as large as its grid.
        total = torch.zeros_like(theta)
        for piece, grad in zip(pieces, grad_images.split(sizes), strict=True):
            total += piece.vjp(grad)
        yield total, again


def _renders(
    problem: AttackProblem, theta: Tensor, rollout: Rollout, steps: range, cache: RenderCache
) -> tuple[list[Rendered], int]:
    """Renders of consecutive steps in order: kept ones singly, runs of missing ones rendered together."""
    pieces: list[Rendered] = []
    missing: list[int] = []
    again = 0

    def fill() -> None:
        if missing:
            pieces.append(problem.sense(missing, rollout.states[missing].flatten(0, 1), theta))
            missing.clear()

    for step in steps:
        kept = cache.take(step)
        if kept is None:
            missing.append(step)
            again += 1
        else:
            fill()
            pieces.append(kept)
    fill()
    return pieces, again


def _sequential_terms(
    problem: AttackProblem,
    theta: Tensor,
    rollout: Rollout,
    control_slopes: Tensor,
    cache: RenderCache,
    memories: Sequence[Tensor],
) -> _Terms:
    """Gradient terms of a policy with memory, last step first, carrying the adjoint of the memory.

    With ``(u_t, m_{t+1}) = pi(o_t, m_t)`` the memory has its own multiplier ``mu_t = (du/dm)^T (df/du)^T lambda_{t+1} +
    (dm_{t+1}/dm_t)^T mu_{t+1}``, and the gradient of an image includes its effect on the memory.
    """
    memory_slope = torch.zeros_like(memories[-1])
    for t in range(len(control_slopes) - 1, -1, -1):
        (rendered,), again = _renders(problem, theta, rollout, range(t, t + 1), cache)
        with torch.enable_grad():
            images = rendered.images.detach().requires_grad_()
            memory = memories[t].detach().requires_grad_()
            outputs = problem.policy(images, problem.goals, memory)
            with_history(outputs[0])
            seeds = (control_slopes[t].to(outputs[0].dtype), memory_slope)
            grad_images, slope = torch.autograd.grad(outputs, (images, memory), seeds, allow_unused=True)
        require_finite_gradient(grad_images)
        memory_slope = torch.zeros_like(memory) if slope is None else slope
        yield rendered.vjp(grad_images), again
