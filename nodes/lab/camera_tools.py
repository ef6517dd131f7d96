"""Implementation of ``advnerf car camera``: finds cameras, tests a source, and converts a ZED's factory calibration."""

from __future__ import annotations

import contextlib
import datetime
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.documents import Document, parse_yaml
from advnerf_core.errors import AdvnerfError
from advnerf_core.strict import parse_value
from calibration.schema import CameraCalibration, load_calibration
from hardware.cameras.interface import Frame
from hardware.cameras.sources import CameraSource
from hardware.cameras.v4l2.controls import available
from hardware.cameras.v4l2.negotiation import identify, modes
from hardware.cameras.v4l2.port import KernelPort, VideoPort, open_device
from hardware.cameras.zed.calibration import Rectifier, load_factory_calibration
from hardware.cameras.zed.exposure import ExtensionUnit, automatic_is_on, read_exposure_lines, read_gain
from hardware.errors import HardwareError
from nodes.lab.doctor.probes import oaks
from nodes.runtime.config import apply_overrides
from nodes.runtime.errors import ConfigError


class CameraToolError(AdvnerfError):
    """A camera does not work as expected."""


def describe_devices(port: VideoPort | None = None) -> Iterator[str]:
    """Yield lines about every video device: its identity, its modes, and its controls with ranges and current values."""
    port = port or KernelPort()
    for name in port.names():
        path = Path(name)
        try:
            fd = open_device(port, path)
        except HardwareError as error:
            yield str(error)
            continue
        try:
            identity = identify(port, fd, path)
            yield f"{name}: {identity.card} ({identity.driver}, {identity.bus})"
            yield from (f"    {mode}" for mode in modes(port, fd))
            for control, (low, high, step, value) in available(port, fd, path).items():
                yield f"    {control}: {value}  ({low} to {high}, step {step})"
            if "ZED" in identity.card.upper():
                unit = ExtensionUnit(port, fd, path)
                automatic = "automatic" if automatic_is_on(unit) else "fixed"
                yield f"    exposure {read_exposure_lines(unit)} lines, gain_raw: {read_gain(unit)} ({automatic})"
        except HardwareError as error:
            yield f"{name}: {error}"
        finally:
            port.close(fd)


def describe_oaks() -> Iterator[str]:
    """Yield one line for each OAK; none if depthai is not installed."""
    with contextlib.suppress(ImportError):
        yield from (f"OAK {line}" for line in oaks())


@dataclass(frozen=True)
class SourceTrial:
    """Measurements of a camera source.

    Attributes:
        missed: Number of missing frames, by frame numbers.
        age_ms: Age of the frames on arrival: median and worst [ms].
        brightness: Mean of all pixels of the last frame, 0 to 255.
    """

    frames: int
    rate_hz: float
    missed: int
    age_ms: tuple[float, float]
    brightness: float
    counters: dict[str, float]
    picture: NDArray[np.uint8]


def source_document(text: str, overrides: Sequence[str] = ()) -> Document:
    """A camera source in YAML, as in a launch file, or a kind alone.

    Args:
        text: ``{kind: ..., key: value}``, or ``KIND``.
        overrides: ``key=value`` texts.
    """
    try:
        document = parse_yaml(text, "source")
    except ConfigError as error:
        raise ConfigError(f"expected YAML such as '{{kind: v4l2, device: ...}}': {error}") from None
    if isinstance(document.data, str):
        document.data = {"kind": document.data}
    apply_overrides(document, overrides)
    return document


def parse_source(text: str, overrides: Sequence[str] = ()) -> Any:
    """The settings of a camera source; arguments as in `source_document`."""
    return parse_value(CameraSource, source_document(text, overrides))


def try_source(source: Any, frames: int = 50, timeout_s: float = 10.0) -> SourceTrial:
    """Read a number of frames of a source, as the camera node does, and measure them."""
    device = source.steady()
    got: list[Frame] = []
    ages_ms = []
    deadline = time.monotonic() + timeout_s
    try:
        while len(got) < frames and time.monotonic() < deadline:
            if (frame := device.read(0.2)) is not None:
                ages_ms.append((time.monotonic_ns() - frame.stamp_mono_ns) / 1e6)
                got.append(frame)
    finally:
        device.close()
    if len(got) < 2:
        raise CameraToolError(
            f"expected frames, got {len(got)} in {timeout_s:g} s: {device.error or 'the source sends no frames'}"
        )
    span_s = (got[-1].stamp_mono_ns - got[0].stamp_mono_ns) / 1e9
    steps = np.diff([frame.sequence for frame in got])
    return SourceTrial(
        frames=len(got),
        rate_hz=(len(got) - 1) / span_s,
        missed=int(np.maximum(steps - 1, 0).sum()),
        age_ms=(float(np.median(ages_ms)), max(ages_ms)),
        brightness=float(got[-1].rgb.mean()),
        counters=device.counters(),
        picture=got[-1].rgb,
    )


def calibration_from_zed(factory: Path, mode: str, size: tuple[int, int], mount: Path) -> CameraCalibration:
    """Make the calibration of the rectified left eye, with the pose on the car from another camera file."""
    pinhole = Rectifier(load_factory_calibration(factory, mode), size).pinhole
    return CameraCalibration(
        date=datetime.date.today(),
        method=f"factory calibration {factory.name}, left eye, {mode}, rectified",
        notes=f"T_car_from_camera from {mount}",
        width=size[0],
        height=size[1],
        fx=round(pinhole.fx, 4),
        fy=round(pinhole.fy, 4),
        cx=round(pinhole.cx, 4),
        cy=round(pinhole.cy, 4),
        T_car_from_camera=load_calibration(CameraCalibration, mount).T_car_from_camera,
        latency_s=0.0,
    )
