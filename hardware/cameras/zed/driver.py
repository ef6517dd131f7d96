"""Driver of the left eye of a ZED without its SDK. The UVC device sends both eyes side by side."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from advnerf_core.geometry import Pinhole
from hardware.cameras.interface import Camera, Frame
from hardware.cameras.stamping import Stamper
from hardware.cameras.v4l2.controls import Controls
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.v4l2.port import KernelPort, VideoPort
from hardware.cameras.zed.calibration import EYE_SIZES, Rectifier, load_factory_calibration
from hardware.cameras.zed.exposure import ExtensionUnit, ZedExposure, exposure_lines, lock_exposure


class ZedCamera(Camera):
    """Delivers rectified, scaled-down images of the left eye.

    Args:
        path: Video device; the stable name under ``/dev/v4l/by-id``.
        factory: The factory calibration ``SN<serial>.conf``.
        mode: Resolution, one of `hardware.cameras.zed.calibration.EYE_SIZES`.
        fps: Frames per second of the device: 15, 30, and up to 60 (HD720) or 100 (VGA) [Hz]; it has no 10.
        rate_hz: Frames per second to deliver, chosen by their stamps; None for all.
        size: Width and height of the delivered pictures [px].
        exposure: Exposure and gain to fix.
        controls: Standard controls. Exposure and gain in them have no effect on a ZED and are refused.
        port: System calls.
        stamper: Converts and checks the kernel's stamps.
    """

    def __init__(
        self,
        path: Path | str,
        factory: Path | str,
        mode: str = "VGA",
        fps: float = 30.0,
        rate_hz: float | None = 10.0,
        size: tuple[int, int] = (336, 188),
        exposure: ZedExposure | None = None,
        controls: Controls | None = None,
        port: VideoPort | None = None,
        stamper: Stamper | None = None,
    ) -> None:
        width, height = EYE_SIZES[mode]
        exposure_lines(100.0, fps)  # refuses rates that the device does not have
        controls = controls or Controls()
        if controls.exposure_us is not None or controls.gain is not None:
            raise ValueError(
                "expected exposure_percent and gain_raw, got exposure_us or gain, which a ZED ignores; replace them"
            )
        self._fps = fps
        self._exposure = exposure or ZedExposure()
        self._port: VideoPort = port or KernelPort()
        self._rectifier = Rectifier(load_factory_calibration(factory, mode), size)
        self._stream = V4l2Camera(
            path,
            Mode(2 * width, height, fps, "YUYV"),
            controls,
            rate_hz,
            columns=(0, width),
            port=self._port,
            started=self._lock,
            stamper=stamper,
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
        if self._exposure.exposure_percent is not None:
            lock_exposure(ExtensionUnit(self._port, fd, self._stream.path), self._exposure, self._fps)
