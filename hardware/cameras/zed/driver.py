"""Driver of the left eye of a ZED without its SDK. The UVC device sends both eyes side by side."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from advnerf_core.geometry import Pinhole
from hardware.cameras.interface import Camera, Frame
from hardware.cameras.source import ControlledSource, Positive
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.v4l2.port import KernelPort, VideoPort
from hardware.cameras.zed.calibration import EYE_SIZES, Rectifier, load_factory_calibration
from hardware.cameras.zed.exposure import ExtensionUnit, ZedExposure, exposure_lines, lock_exposure


class ZedSource(ControlledSource):
    """A ZED without its SDK: its left eye, rectified.

    Attributes:
        kind: ``zed``.
        device: Stable path, ``/dev/v4l/by-id/...ZED...-video-index0``.
        factory: Factory calibration, ``SN<serial>.conf``.
        mode: Resolution.
        fps: Rate of the device: 15, 30, 60 or 100 [Hz].
        rate_hz: Frames to deliver per second, chosen by their stamps [Hz]; None for all.
        size: Width and height of the delivered images [px].
        exposure_percent: Exposure to fix [% of the longest at this rate]; None for automatic.
        gain_raw: Gain to fix, as in the sensor's register; ``advnerf car camera list`` shows the current value.
    """

    kind: Literal["zed"] = "zed"
    device: Path
    factory: Path
    mode: Literal["2K", "HD1080", "HD720", "VGA"] = "VGA"
    fps: float = 30.0
    rate_hz: float | None = Field(default=10.0, gt=0.0)
    size: tuple[Positive, Positive] = (336, 188)
    exposure_percent: float | None = None
    gain_raw: int | None = None

    @model_validator(mode="after")
    def _possible(self) -> ZedSource:
        _ = self.device_controls(), self.exposure  # they check their values
        exposure_lines(100.0, self.fps)
        width, height = EYE_SIZES[self.mode]
        if self.size[0] > width or self.size[1] > height:
            raise ValueError(
                f"expected a size of at most {width} x {height} in mode {self.mode}, got {self.size}"
            )
        if self.rate_hz is not None and self.rate_hz > self.fps:
            raise ValueError(f"expected rate_hz of at most fps, {self.fps:g}, got {self.rate_hz:g}")
        return self

    @property
    def exposure(self) -> ZedExposure:
        """Exposure and gain to fix."""
        return ZedExposure(self.exposure_percent, self.gain_raw)

    def period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.rate_hz if self.rate_hz else 0.0

    def camera(self) -> ZedCamera:
        """Make the camera and read its factory calibration."""
        return ZedCamera(self)


class ZedCamera(Camera):
    """Delivers rectified, scaled-down images of the left eye.

    Raises:
        ZedCalibrationError: The factory calibration is missing or wrong.
    """

    def __init__(self, settings: ZedSource, port: VideoPort | None = None) -> None:
        width, height = EYE_SIZES[settings.mode]
        self._settings = settings
        self._port: VideoPort = port or KernelPort()
        calibration = load_factory_calibration(settings.factory, settings.mode)
        self._rectifier = Rectifier(calibration, settings.size)
        self._stream = V4l2Camera(
            settings.device,
            Mode(2 * width, height, settings.fps, "YUYV"),
            settings.device_controls(),
            settings.rate_hz,
            columns=(0, width),
            port=self._port,
            started=self._lock,
        )

    @property
    def pinhole(self) -> Pinhole:
        """The ideal camera after rectification and scaling."""
        return self._rectifier.pinhole

    def open(self) -> None:
        """Start the stream and fix the exposure."""
        self._stream.open()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest unread frame, or None after ``timeout_s``."""
        frame = self._stream.read(timeout_s)
        return None if frame is None else dataclasses.replace(frame, rgb=self._rectifier(frame.rgb))

    def close(self) -> None:
        """Stop the stream."""
        self._stream.close()

    def counters(self) -> dict[str, float]:
        """See `V4l2Camera.counters`."""
        return self._stream.counters()

    def _lock(self, fd: int) -> None:
        if self._settings.exposure_percent is not None:
            unit = ExtensionUnit(self._port, fd, self._stream.path)
            lock_exposure(unit, self._settings.exposure, self._settings.fps)
