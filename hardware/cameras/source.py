"""Common settings of all cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod

from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.cameras.interface import Camera
from hardware.cameras.steady import SteadyCamera


class Source(StrictModel, ABC):
    """Settings that all sources have.

    Attributes:
        stall_s: Time without a frame after which the device is reopened [s].
        repeats: Number of identical images in a row that count as a stall; 0 for never.
    """

    stall_s: float = Field(default=1.0, gt=0.0)
    repeats: int = Field(default=0, ge=0)

    @abstractmethod
    def camera(self) -> Camera:
        """Make the camera."""

    def steady(self) -> SteadyCamera:
        """Make the camera with automatic reconnection."""
        stall_s = max(self.stall_s, 3.0 * self.period_s())
        return SteadyCamera(self.camera(), stall_s, max(5.0, stall_s), self.repeats)

    def period_s(self) -> float:
        """Time between two frames if the configuration has a rate, so that a slow rate is not a stall [s]."""
        return 0.0
