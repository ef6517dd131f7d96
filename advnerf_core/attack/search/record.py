"""What a search hands on: each of its evaluations, and what it found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Evaluation:
    """One closed-loop evaluation of a search.

    Attributes:
        iteration: Number of the evaluation, from 0.
        loss_m: The objective's loss, mean over starts, with the regulariser's part; for ``cte`` in metres.
        total_cte_m: Sum of |CTE| of each start [m].
        protocol_cte_m: Total CTE of each start by the protocol, which stops the car at the fence [m].
        seconds: Time of the evaluation, including its gradient if any [s].
        values: The objective's value of each start, in the objective's unit; for ``cte`` these are ``protocol_cte_m``.
    """

    iteration: int
    loss_m: float
    total_cte_m: tuple[float, ...]
    protocol_cte_m: tuple[float, ...]
    seconds: float
    values: tuple[float, ...]

    @property
    def value(self) -> float:
        """Mean over starts of the objective's value: the best evaluation has the highest."""
        return sum(self.values) / len(self.values)

    @property
    def predicted_total_cte_m(self) -> float:
        """Mean over starts of the total CTE by the protocol [m], which is reported for all objectives."""
        return sum(self.protocol_cte_m) / len(self.protocol_cte_m)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        theta: The best parameters, ``theta_shape``.
        best: Evaluation of ``theta``.
        history: All evaluations, in order.
    """

    theta: Tensor
    best: Evaluation
    history: tuple[Evaluation, ...]


OnEvaluation = Callable[[Evaluation], None]
