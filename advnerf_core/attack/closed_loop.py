"""Cosine between the adjoint's gradient and the true closed loop's, with an interval, if it can be measured.

The true closed loop, in which images follow the states, jumps wherever an edge crosses a pixel. Its finite differences therefore
depend on their step: a cosine from one step says nothing. Here the loop is differenced over a sweep of steps, along the gradient
and along random directions at a right angle to it, and a cosine is given only where consecutive steps agree.

With ``a`` the closed loop's slope along the gradient ``g / |g|`` and ``S`` the sum of its squared slopes along ``K`` random
orthonormal directions in the ``N - 1`` dimensions beside it, the cosine is ``a / sqrt(a^2 + P)``, where ``P``, the squared norm of
the part beside the gradient, is estimated by ``S (N - 1) / K``. As the directions are uniform, ``S / P`` follows the
Beta(K / 2, (N - 1 - K) / 2) distribution for any loop, which gives the interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from scipy.stats import beta
from torch import Tensor

from advnerf_core.geometry import Array

STEPS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # in theta, along unit directions
CONFIDENCE = 0.95
# Consecutive steps agree if their slopes differ by at most this share; at least this many must agree.
_AGREEMENT, _RUN = 0.25, 3

Loss = Callable[[Tensor], float]


@dataclass(frozen=True)
class CosineAtStep:
    """Result of finite differences with one step.

    Attributes:
        step: Half the distance between the two evaluations, in theta.
        cosine: Cosine between the gradient and the closed loop's; 0 if the loop does not change.
        low: Lower end of its interval over choices of directions.
        high: Upper end of the interval.
        along: Slope of the closed loop along the gradient.
        beside: Slopes of the closed loop along the random directions.
    """

    step: float
    cosine: float
    low: float
    high: float
    along: float
    beside: tuple[float, ...]


@dataclass(frozen=True)
class ClosedLoopCosine:
    """The cosine to the true closed loop.

    Attributes:
        at_steps: Result for each step of the sweep, the largest first.
        plateau: Steps that agree with one another; None if there are not enough of them.
        dimensions: Length of theta.
    """

    at_steps: tuple[CosineAtStep, ...]
    plateau: tuple[float, ...] | None
    dimensions: int

    @property
    def interval(self) -> tuple[float, float, float] | None:
        """Cosine, lower and upper end over the steps that agree; None if too few agree."""
        if self.plateau is None:
            return None
        agreeing = [at for at in self.at_steps if at.step in self.plateau]
        middle = float(np.median([at.cosine for at in agreeing]))
        return middle, min(at.low for at in agreeing), max(at.high for at in agreeing)

    @property
    def in_words(self) -> str:
        """The cosine with its interval, or the reason why it is unknown."""
        if self.interval is not None and self.plateau is not None:
            cosine, low, high = self.interval
            return (
                f"cosine to the true closed loop {cosine:+.2f} ({CONFIDENCE:.0%} interval {low:+.2f} to {high:+.2f}; finite differences "
                f"agree at steps {self.plateau[0]:g} to {self.plateau[-1]:g})"
            )
        if all(at.along == 0.0 and not any(at.beside) for at in self.at_steps):
            return (
                "cosine to the true closed loop CANNOT BE TOLD: the loop does not change along any direction"
            )
        swept = ", ".join(f"{at.cosine:+.2f} at {at.step:g}" for at in self.at_steps)
        return (
            "cosine to the true closed loop CANNOT BE TOLD: its finite differences depend on their step, as of a loop that jumps "
            f"({swept})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain data, with the interval and the text."""
        return {**asdict(self), "interval": self.interval, "in_words": self.in_words}


def closed_loop_cosine(
    loss: Loss,
    theta: Tensor,
    gradient: Tensor,
    directions: int = 8,
    seed: int = 0,
    told: Callable[[float], None] = lambda done: None,
) -> ClosedLoopCosine:
    """Compare a gradient with finite differences of the closed loop.

    It evaluates the loss ``2 * len(STEPS) * (1 + directions)`` times: central differences of several steps along unit directions.

    Args:
        loss: Loss of the true closed loop for a theta, with the same draws every time.
        theta: Point of the comparison, float64.
        gradient: The adjoint's gradient there, of the same shape.
        directions: Random directions beside the gradient; at most as many as there are dimensions beside it.
        told: Progress callback, called with the finished share.

    Raises:
        ValueError: No direction.
    """
    if directions < 1:
        raise ValueError(f"expected at least 1 direction, got {directions}")
    frame = _frame(gradient, directions, seed)
    if frame is None:  # without a gradient there is no angle to it
        return ClosedLoopCosine(
            tuple(CosineAtStep(s, 0.0, 0.0, 0.0, 0.0, ()) for s in STEPS), None, theta.numel()
        )
    found = []
    for number, step in enumerate(STEPS):
        slopes = []
        for k, direction in enumerate(frame):
            slopes.append((loss(theta + step * direction) - loss(theta - step * direction)) / (2.0 * step))
            told((number + (k + 1) / len(frame)) / len(STEPS))
        found.append(_at_step(step, slopes[0], slopes[1:], theta.numel()))
    return ClosedLoopCosine(tuple(found), _plateau(found, theta.numel()), theta.numel())


def _frame(gradient: Tensor, directions: int, seed: int) -> Tensor | None:
    """Orthonormal directions ``[1 + K, *shape]``: the gradient's, and random ones beside it; None if the gradient is zero."""
    flat = gradient.detach().double().flatten()
    if not float(flat.norm()) > 0.0:
        return None
    count = min(directions, flat.numel() - 1)
    noise = torch.randn(
        flat.numel(), count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    # The first column of Q is the gradient's direction up to its sign; a Gaussian frame beside it is uniform.
    q, _ = torch.linalg.qr(torch.cat([flat[:, None], noise], dim=1))
    q[:, 0] = flat / flat.norm()
    return q.T.reshape(1 + count, *gradient.shape)


def _at_step(step: float, along: float, beside: Sequence[float], dimensions: int) -> CosineAtStep:
    count, rest = len(beside), dimensions - 1
    size = float(np.square(beside).sum())
    # All dimensions beside the gradient were differenced, or a share of them that is known in distribution.
    shares = [1.0, 1.0, 1.0]
    if count < rest:
        tail = (1.0 - CONFIDENCE) / 2.0
        shares = [
            count / rest,
            *(float(beta.ppf(p, count / 2.0, (rest - count) / 2.0)) for p in (tail, 1.0 - tail)),
        ]
    ends = [_ratio(along, size / share) for share in shares]
    return CosineAtStep(step, ends[0], min(ends), max(ends), along, tuple(beside))


def _ratio(along: float, beside_squared: float) -> float:
    norm = float(np.sqrt(along**2 + beside_squared))
    return along / norm if norm > 0.0 else 0.0


def _plateau(found: Sequence[CosineAtStep], dimensions: int) -> tuple[float, ...] | None:
    """The longest run of consecutive steps whose slopes agree."""
    slopes = [_whole(at, dimensions) for at in found]
    runs: list[list[int]] = [[0]]
    for k in range(1, len(found)):
        largest = max(float(np.linalg.norm(slopes[k - 1])), float(np.linalg.norm(slopes[k])))
        agrees = largest > 0.0 and float(np.linalg.norm(slopes[k] - slopes[k - 1])) <= _AGREEMENT * largest
        runs.append([k]) if not agrees else runs[-1].append(k)
    best = max(runs, key=len)
    return tuple(found[k].step for k in best) if len(best) >= _RUN else None


def _whole(at: CosineAtStep, dimensions: int) -> Array:
    """The slopes, each beside the gradient weighted by the number of directions that it stands for: a vector as long as the loop's gradient."""
    weight = np.sqrt((dimensions - 1) / max(1, len(at.beside)))
    return np.array([at.along, *(weight * slope for slope in at.beside)])
