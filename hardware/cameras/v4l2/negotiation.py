"""Sets size, pixel format and rate of a video device, and compares its answer with the request."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hardware.cameras.pixels import PIXEL_FORMATS, PixelLayout, least_bytes_per_line
from hardware.cameras.v4l2 import abi
from hardware.cameras.v4l2.port import VideoPort, request
from hardware.errors import ProtocolError

_RATE_TOLERANCE = 0.01  # 29.97 for 30 is the same rate
_MOST = 64  # of anything a device enumerates


@dataclass(frozen=True)
class Mode:
    """Requested mode of a video device.

    Attributes:
        width: Columns [px].
        height: Rows [px].
        fps: Frames per second of the device [Hz].
        pixel_format: Four letters, one of `hardware.cameras.pixels.PIXEL_FORMATS`.
    """

    width: int
    height: int
    fps: float
    pixel_format: str = "YUYV"

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or not self.fps > 0.0:
            raise ValueError(f"expected a size and a rate above zero, got {self}")
        if self.pixel_format not in PIXEL_FORMATS:
            raise ValueError(
                f"expected a pixel format of {', '.join(PIXEL_FORMATS)}, got {self.pixel_format!r}"
            )

    def __str__(self) -> str:
        return f"{self.width} x {self.height} {self.pixel_format} at {self.fps:g} Hz"


@dataclass(frozen=True)
class Identity:
    """Identity that a device reports.

    Attributes:
        card: Product name.
        driver: Kernel module.
        bus: Bus position.
    """

    card: str
    driver: str
    bus: str


def identify(port: VideoPort, fd: int, path: Path) -> Identity:
    """Read the identity of a device, and check that it delivers images by mapped buffers."""
    found = abi.Capability()
    request(port, fd, path, abi.QUERYCAP, found, "asking what it is")
    caps = found.device_caps if found.capabilities & abi.CAP_DEVICE_CAPS else found.capabilities
    identity = Identity(
        *(bytes(text).decode("utf-8", "replace") for text in (found.card, found.driver, found.bus_info))
    )
    if not caps & abi.CAP_VIDEO_CAPTURE:
        why = (
            "it gives metadata only; take the device whose name ends in video-index0"
            if caps & abi.CAP_META_CAPTURE
            else "its multi-planar interface is not supported; bring its frames to the socket source"
            if caps & abi.CAP_VIDEO_CAPTURE_MPLANE
            else "it is not a camera"
        )
        raise ProtocolError(f"expected a camera at {path}, found {identity.card}: {why}")
    if not caps & abi.CAP_STREAMING:
        raise ProtocolError(
            f"{path} ({identity.card}) does not stream into mapped buffers, which are required; use another camera"
        )
    return identity


def agree(
    port: VideoPort, fd: int, path: Path, mode: Mode, columns: tuple[int, int] | None = None
) -> PixelLayout:
    """Set a mode, read it back, and return the memory layout. Raises `ProtocolError` if the device chose another mode."""
    asked = abi.Format(type=abi.CAPTURE)
    asked.fmt.pix = abi.PixelFormat(
        width=mode.width, height=mode.height, pixelformat=abi.fourcc(mode.pixel_format), field=abi.FIELD_NONE
    )
    request(port, fd, path, abi.S_FMT, asked, f"setting {mode}")
    answer = abi.Format(type=abi.CAPTURE)
    request(port, fd, path, abi.G_FMT, answer, "reading the mode back")
    got = answer.fmt.pix
    if (got.width, got.height, got.pixelformat) != (mode.width, mode.height, abi.fourcc(mode.pixel_format)):
        chosen = f"{got.width} x {got.height} {abi.fourcc_name(got.pixelformat)}"
        raise ProtocolError(
            f"expected {mode.width} x {mode.height} {mode.pixel_format} from {path}, got {chosen}; it offers"
            f" {describe(port, fd)}"
        )
    least = least_bytes_per_line(mode.pixel_format, mode.width)
    if least and got.bytesperline < least:
        raise ProtocolError(f"expected rows of at least {least} bytes from {path}, got {got.bytesperline}")
    _agree_on_rate(port, fd, path, mode)
    return PixelLayout(
        mode.pixel_format,
        mode.width,
        mode.height,
        got.bytesperline if least else 0,
        columns or (0, mode.width),
    )


def _agree_on_rate(port: VideoPort, fd: int, path: Path, mode: Mode) -> None:
    asked = abi.StreamParameters(type=abi.CAPTURE)
    asked.parm.capture.timeperframe = abi.Fraction(1000, round(mode.fps * 1000))
    request(port, fd, path, abi.S_PARM, asked, f"setting {mode.fps:g} Hz")
    answer = abi.StreamParameters(type=abi.CAPTURE)
    request(port, fd, path, abi.G_PARM, answer, "reading the rate back")
    interval = answer.parm.capture.timeperframe
    got_hz = interval.denominator / interval.numerator if interval.numerator else 0.0
    if abs(got_hz - mode.fps) > _RATE_TOLERANCE * mode.fps:
        raise ProtocolError(
            f"expected {mode.fps:g} Hz from {path}, got {got_hz:g} Hz; it offers {describe(port, fd)}"
        )


def describe(port: VideoPort, fd: int) -> str:
    """List the formats, sizes and rates of a device in one line."""
    return "; ".join(modes(port, fd)) or "no listed modes"


def modes(port: VideoPort, fd: int) -> Iterator[str]:
    """Yield one text for each pixel format of a device."""
    for pixel_format in _formats(port, fd):
        sizes = []
        for width, height in _sizes(port, fd, pixel_format):
            rates = "/".join(f"{rate:g}" for rate in _rates(port, fd, pixel_format, width, height))
            sizes.append(f"{width}x{height}" + (f"@{rates}" if rates else ""))
        yield f"{abi.fourcc_name(pixel_format)} {' '.join(sizes)}".rstrip()


def _enumerated(
    port: VideoPort, fd: int, number: int, make: type[ctypes.Structure], **fixed: int
) -> Iterator[ctypes.Structure]:
    for index in range(_MOST):
        entry = make(index=index, **fixed)
        try:
            port.ioctl(fd, number, entry)
        except OSError:
            return  # EINVAL: that was the last one
        yield entry


def _formats(port: VideoPort, fd: int) -> list[int]:
    found = _enumerated(port, fd, abi.ENUM_FMT, abi.FormatDescription, type=abi.CAPTURE)
    return [entry.pixelformat for entry in found]


def _sizes(port: VideoPort, fd: int, pixel_format: int) -> list[tuple[int, int]]:
    found = _enumerated(port, fd, abi.ENUM_FRAMESIZES, abi.FrameSize, pixel_format=pixel_format)
    return [(entry.width, entry.height) for entry in found if entry.type == 1]


def _rates(port: VideoPort, fd: int, pixel_format: int, width: int, height: int) -> list[float]:
    found = _enumerated(
        port,
        fd,
        abi.ENUM_FRAMEINTERVALS,
        abi.FrameInterval,
        pixel_format=pixel_format,
        width=width,
        height=height,
    )
    intervals = [entry.discrete for entry in found if entry.type == 1]
    return [round(i.denominator / i.numerator, 2) for i in intervals if i.numerator]
