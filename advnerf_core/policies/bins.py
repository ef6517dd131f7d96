"""Classifiers as steering: an output with a score for each of several steering values."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from advnerf_core.policies.arrays import array_module, like
from advnerf_core.strict import StrictModel


class SteeringBins(StrictModel):
    """An output ``[B, N]`` of scores.

    Attributes:
        values: Steering of each bin, in the declared unit and to the declared side.
        choice: ``largest`` takes the value of the largest score, which has no gradient; ``mean`` weights the values by the scores, which are
            probabilities; ``softmax`` does so after a softmax.
    """

    values: tuple[float, ...] = Field(min_length=2)
    choice: Literal["largest", "mean", "softmax"] = "largest"

    def value(self, scores: Any) -> Any:
        """Steering ``[B]`` of scores ``[B, N]`` (numpy or torch)."""
        values = like(scores, self.values)
        if self.choice == "largest":
            return values[scores.argmax(1)]
        if self.choice == "softmax":
            # The exponents are at most 0, so that none overflows.
            largest = scores[range(len(scores)), scores.argmax(1)]
            scores = array_module(scores).exp(scores - largest[:, None])
        return (scores * values).sum(1) / scores.sum(1)
