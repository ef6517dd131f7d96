"""The limits of the fidelity gate, in a separate module because configuration files need them without its computations."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from advnerf_core.strict import StrictModel

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class GateLimits(StrictModel):
    """Required fidelity of a surrogate; the first two follow the targets of the room's experiment."""

    psnr_db: Positive = Field(default=25.0, description="Least mean PSNR at the policy's size [dB].")
    ssim: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        default=0.8, description="Least mean SSIM at the policy's size."
    )
    steering: Positive = Field(
        default=0.03,
        description="Greatest mean steering difference [rad], or turn-rate difference [rad/s] for a Dubins car.",
    )
    correlation: Annotated[float, Field(ge=-1.0, le=1.0)] = Field(
        default=0.8, description="Least correlation of the steering on learned and real pictures."
    )
    views: Annotated[int, Field(ge=3)] = Field(
        default=10, description="Fewer pictures than this decide nothing."
    )
