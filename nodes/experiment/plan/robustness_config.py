"""The section ``robustness`` of requests and experiments: disturbances that an attack must withstand."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from advnerf_core.strict import RightAngleRad, StrictModel, at_most
from nodes.experiment.plan.numbers import NotNegative, Positive, Unit


class RobustnessConfig(StrictModel):
    """Disturbances that the attack must withstand: the loss is an expectation over these, with new draws in every evaluation."""

    noise: Unit = Field(default=0.0, description="Pixel noise, standard deviation in 0..1.")
    gain: Unit = Field(default=0.0, description="Spread of the logarithm of the exposure of a drive.")
    brightness: Unit = Field(default=0.0, description="Spread of a drive's additive brightness, in 0..1.")
    jitter_m: Annotated[float, at_most(1.0, "m", "cm or mm")] = Field(
        default=0.0, ge=0.0, description="Spread of the camera's position in each frame [m]."
    )
    jitter_rad: RightAngleRad = Field(
        default=0.0, ge=0.0, description="Spread of the camera's rotation in each frame [rad]."
    )
    draws: Positive = Field(
        default=1, description="Drives of each start pose per evaluation, each drawn by itself."
    )
    smoothness: NotNegative = Field(
        default=0.0, description="Weight of the texture's total variation in the loss [m per unit of colour]."
    )

    @property
    def spreads(self) -> dict[str, float]:
        """Spreads of all disturbances, as `advnerf_core.attack.robustness.Disturbances` names them."""
        return self.model_dump(exclude={"draws", "smoothness"})

    @property
    def disturbed(self) -> bool:
        """Whether any disturbance is drawn."""
        return any(self.spreads.values())

    @property
    def repeats(self) -> int:
        """Drives of each start pose per evaluation."""
        return self.draws if self.disturbed else 1
