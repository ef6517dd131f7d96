"""Common settings of all cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.cameras.interface import RECORDED, Camera
from hardware.cameras.steady import SteadyCamera
from hardware.cameras.v4l2.controls import Controls

Positive = Annotated[int, Field(gt=0)]


class Source(StrictModel, ABC):
    """Settings that all sources have.

    Attributes:
        stall_s: Time without a frame after which the device is reopened [s].
        repeats: Number of identical images in a row after which the device is reopened; each is withheld. 0 for never. Images of
            the simulated lab do not count.
    """

    stall_s: float = Field(default=1.0, gt=0.0)
    repeats: int = Field(default=15, ge=0)

    @abstractmethod
    def camera(self) -> Camera:
        """Make the camera."""

    def steady(self) -> SteadyCamera:
        """Make the camera with automatic reconnection."""
        stall_s, camera = max(self.stall_s, 3.0 * self.period_s()), self.camera()
        may_repeat = "repeats" not in self.model_fields_set and RECORDED in camera.counters()
        return SteadyCamera(camera, stall_s, max(5.0, stall_s), 0 if may_repeat else self.repeats)

    def period_s(self) -> float:
        """Time between two frames if the configuration has a rate, so that a slow rate is not a stall [s]."""
        return 0.0


class ControlledSource(Source):
    """A device with the standard controls of video devices.

    Attributes:
        white_balance_k: Colour temperature to fix [K]; None for automatic.
        power_line_hz: Mains frequency for the device's flicker compensation [Hz].
        controls: Further controls by name, in the device's own units (``advnerf car camera list`` shows them).
    """

    white_balance_k: int | None = None
    power_line_hz: Literal[0, 50, 60] | None = None
    controls: dict[str, int] = Field(default_factory=dict)

    def device_controls(self, exposure_us: float | None = None, gain: int | None = None) -> Controls:
        """The controls to fix, and the exposure [us] and gain beside them."""
        return Controls(exposure_us, gain, self.white_balance_k, self.power_line_hz, self.controls)
