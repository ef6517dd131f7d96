"""Configuration classes for ``source`` of the camera node, one for each kind of device."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from hardware.cameras.file import FileCamera
from hardware.cameras.foreign import foreign_source
from hardware.cameras.oak import OakSource
from hardware.cameras.pixels import PIXEL_FORMATS
from hardware.cameras.socket import SocketCamera
from hardware.cameras.source import Source
from hardware.cameras.v4l2.controls import Controls
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.video import VideoCamera
from hardware.cameras.zed.calibration import EYE_SIZES
from hardware.cameras.zed.driver import ZedCamera
from hardware.cameras.zed.exposure import ZedExposure, exposure_lines

Positive = Annotated[int, Field(gt=0)]


class _ControlledSource(Source):
    """A device with the standard controls of video devices.

    Attributes:
        white_balance_k: Colour temperature to fix [K]; None for automatic.
        power_line_hz: Mains frequency for the device's flicker compensation [Hz].
        controls: Further controls by name, in the device's own units (``advnerf car camera list`` shows them).
    """

    white_balance_k: int | None = None
    power_line_hz: Literal[0, 50, 60] | None = None
    controls: dict[str, int] = Field(default_factory=dict)

    def _controls(self, exposure_us: float | None = None, gain: int | None = None) -> Controls:
        return Controls(exposure_us, gain, self.white_balance_k, self.power_line_hz, self.controls)


class V4l2Source(_ControlledSource):
    """A video device of Linux: USB webcams, v4l2loopback, vivid.

    Attributes:
        kind: ``v4l2``.
        device: Stable path, ``/dev/v4l/by-id/...-video-index0``.
        width: Width of the device's images [px].
        height: Height of the device's images [px].
        fps: Rate of the device [Hz].
        pixel_format: Four letters.
        rate_hz: Frames to deliver per second, chosen by their stamps [Hz]; None for all.
        size: Width and height to scale the images to [px]; None keeps their size.
        exposure_us: Exposure time to fix [us]; None for automatic.
        gain: Gain to fix, in the device's own units.
    """

    kind: Literal["v4l2"] = "v4l2"
    device: Path
    width: Positive
    height: Positive
    fps: float = Field(default=30.0, gt=0.0)
    pixel_format: Literal[PIXEL_FORMATS] = "YUYV"  # type: ignore[valid-type]
    rate_hz: float | None = Field(default=10.0, gt=0.0)
    size: tuple[Positive, Positive] | None = None
    exposure_us: float | None = None
    gain: int | None = None
    repeats: int = Field(default=15, ge=0)

    @model_validator(mode="after")
    def _possible(self) -> V4l2Source:
        self.camera()  # opens no device; the driver checks the settings
        return self

    def period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.rate_hz if self.rate_hz else 0.0

    def camera(self) -> V4l2Camera:
        """Make the camera."""
        mode = Mode(self.width, self.height, self.fps, self.pixel_format)
        controls = self._controls(self.exposure_us, self.gain)
        return V4l2Camera(self.device, mode, controls, self.rate_hz, size=self.size)


class ZedSource(_ControlledSource):
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
    repeats: int = Field(default=15, ge=0)

    @model_validator(mode="after")
    def _possible(self) -> ZedSource:
        self._controls()
        ZedExposure(self.exposure_percent, self.gain_raw)
        exposure_lines(100.0, self.fps)
        width, height = EYE_SIZES[self.mode]
        if self.size[0] > width or self.size[1] > height:
            raise ValueError(
                f"expected a size of at most {width} x {height} in mode {self.mode}, got {self.size}"
            )
        if self.rate_hz is not None and self.rate_hz > self.fps:
            raise ValueError(f"expected rate_hz of at most fps, {self.fps:g}, got {self.rate_hz:g}")
        return self

    def period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.rate_hz if self.rate_hz else 0.0

    def camera(self) -> ZedCamera:
        """Make the camera and read its factory calibration."""
        exposure = ZedExposure(self.exposure_percent, self.gain_raw)
        return ZedCamera(
            self.device,
            self.factory,
            self.mode,
            self.fps,
            self.rate_hz,
            self.size,
            exposure,
            self._controls(),
        )


class SocketSource(Source):
    """Frames from a Unix socket, of the twin or of your own camera server.

    Attributes:
        kind: ``socket``.
        path: Path of the socket; ``${socket_dir}/frames`` for the twin.
    """

    kind: Literal["socket"] = "socket"
    path: Path

    def camera(self) -> SocketCamera:
        """Make the camera."""
        return SocketCamera(self.path)


class FileSource(Source):
    """A recorded video.

    Attributes:
        kind: ``file``.
        path: The video.
        rate_hz: Frame rate; None uses the video's [Hz].
        loop: Start over after the last frame.
    """

    kind: Literal["file"] = "file"
    path: Path
    rate_hz: float | None = Field(default=None, gt=0.0)
    loop: bool = True

    def period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.rate_hz if self.rate_hz else 0.0

    def camera(self) -> VideoCamera:
        """Make the camera."""
        return VideoCamera(self.path, self.rate_hz, self.loop)


class FolderSource(Source):
    """Recorded images.

    Attributes:
        kind: ``folder``.
        folder: Folder of numbered images.
        rate_hz: Frame rate [Hz].
        loop: Start over after the last image.
    """

    kind: Literal["folder"] = "folder"
    folder: Path
    rate_hz: float = Field(default=10.0, gt=0.0)
    loop: bool = True

    def period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.rate_hz

    def camera(self) -> FileCamera:
        """Make the camera."""
        return FileCamera(self.folder, self.rate_hz, self.loop)


CAMERAS: Mapping[str, type[Source]] = MappingProxyType(
    {
        "v4l2": V4l2Source,
        "zed": ZedSource,
        "oak": OakSource,
        "socket": SocketSource,
        "file": FileSource,
        "folder": FolderSource,
    }
)
"""Settings of the cameras that this project brings, by their ``kind``."""


def _of_any_kind(value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    kind = value.get("kind") if isinstance(value, Mapping) else None
    if not isinstance(kind, str):
        return handler(value)
    folder = (info.context or {}).get("folder")
    own = foreign_source(value, CAMERAS, folder)
    return handler(value) if own is None else own


CameraSource = Annotated[
    V4l2Source | ZedSource | OakSource | SocketSource | FileSource | FolderSource,
    Field(discriminator="kind"),
    WrapValidator(_of_any_kind),
]
"""One of `CAMERAS`, or `hardware.cameras.foreign.ForeignSource` for an entry point or ``file.py:Class``."""
