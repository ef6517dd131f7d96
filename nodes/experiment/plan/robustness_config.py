"""The section ``robustness`` of requests and experiments: disturbances that an attack must withstand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pydantic import Field

from advnerf_core.strict import StrictModel
from nodes.experiment.plan.numbers import NotNegative, Positive

if TYPE_CHECKING:
    from advnerf_core.attack.robustness import Disturbances, Smoothness
    from advnerf_core.fields.coloured import ColouredObject


class RobustnessConfig(StrictModel):
    """Disturbances that the attack must withstand: the loss is an expectation over these, with new draws in every evaluation."""

    noise: NotNegative = Field(default=0.0, description="Pixel noise, standard deviation in 0..1.")
    gain: NotNegative = Field(default=0.0, description="Spread of the logarithm of the exposure of a drive.")
    brightness: NotNegative = Field(
        default=0.0, description="Spread of a drive's additive brightness, in 0..1."
    )
    jitter_m: NotNegative = Field(
        default=0.0, description="Spread of the camera's position in each frame [m]."
    )
    jitter_rad: NotNegative = Field(
        default=0.0, description="Spread of the camera's rotation in each frame [rad]."
    )
    draws: Positive = Field(
        default=1, description="Drives of each start pose per evaluation, each drawn by itself."
    )
    smoothness: NotNegative = Field(
        default=0.0, description="Weight of the texture's total variation in the loss [m per unit of colour]."
    )

    @property
    def disturbed(self) -> bool:
        """Whether any disturbance is drawn."""
        return any((self.noise, self.gain, self.brightness, self.jitter_m, self.jitter_rad))

    @property
    def repeats(self) -> int:
        """Drives of each start pose per evaluation."""
        return self.draws if self.disturbed else 1

    def disturbances(self, seed: int) -> Disturbances | None:
        """Disturbances of every evaluation of a search; None if there are none."""
        from advnerf_core.attack.robustness import Disturbances

        if not self.disturbed:
            return None
        return Disturbances(self.noise, self.gain, self.brightness, self.jitter_m, self.jitter_rad, seed)

    def regulariser(self, objects: Sequence[ColouredObject]) -> Smoothness | None:
        """Penalty for rough colours of the attacked objects; None without a weight."""
        from advnerf_core.attack.robustness import Smoothness

        return Smoothness(objects, self.smoothness) if self.smoothness else None
