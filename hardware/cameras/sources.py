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
from hardware.cameras.source import ControlledSource, Positive, Source
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.video import VideoCamera
from hardware.cameras.zed.driver import ZedSource


class V4l2Source(ControlledSource):
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
        controls = self.device_controls(self.exposure_us, self.gain)
        return V4l2Camera(self.device, mode, controls, self.rate_hz, size=self.size)


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
