"""Driver of OAK cameras (Luxonis, depthai 3): one image stream, undistorted by the device, stamped on the host's steady clock."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from advnerf_core.geometry import Pinhole
from hardware.cameras.interface import Camera, Frame
from hardware.cameras.source import Source
from hardware.cameras.stamping import Stamper
from hardware.errors import DeviceBusy, DeviceNotFound, HardwareError, LinkLost, ProtocolError

_ISO_DEFAULT = 400


class OakSource(Source):
    """An OAK camera (depthai 3), undistorted by the device.

    Attributes:
        kind: ``oak``.
        device: Id, IP address or USB port of the device; empty for the only one.
        socket: Board socket of the camera.
        width: Columns [px].
        height: Rows [px].
        fps: Frames per second [Hz].
        undistort: Whether the device removes the distortion.
        exposure_us: Exposure time to fix [us]; None for automatic.
        iso: Sensitivity for a fixed exposure.
        white_balance_k: Colour temperature to fix [K]; None for automatic.
    """

    kind: Literal["oak"] = "oak"
    device: str = ""
    socket: str = "CAM_A"
    width: int = Field(default=336, gt=0)
    height: int = Field(default=188, gt=0)
    fps: float = Field(default=10.0, gt=0.0)
    undistort: bool = True
    exposure_us: int | None = None
    iso: int | None = None
    white_balance_k: int | None = None

    @model_validator(mode="after")
    def _possible(self) -> OakSource:
        if self.iso is not None and self.exposure_us is None:
            raise ValueError("expected exposure_us and iso together, got one; give both or none")
        for name, value, low, high in (
            ("exposure_us", self.exposure_us, 1, 33_000_000),
            ("iso", self.iso, 100, 1600),
            ("white_balance_k", self.white_balance_k, 1000, 12000),
        ):
            if value is not None and not low <= value <= high:
                raise ValueError(f"expected {name} of {low} to {high}, got {value}")
        return self

    def period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.fps

    def camera(self) -> OakCamera:
        """Make the camera."""
        return OakCamera(self)


@dataclass(frozen=True, eq=False)
class OakStream:
    """A pipeline that is not started yet, and its output queue.

    Attributes:
        pipeline: ``depthai.Pipeline``.
        queue: ``depthai.MessageQueue`` of ``ImgFrame``, of length 1 and not blocking.
        pinhole: Intrinsics of the images from the factory calibration; None without one.
        device: ``depthai.Device`` to close at the end; None for a pipeline on the host.
    """

    pipeline: Any
    queue: Any
    pinhole: Pinhole | None = None
    device: Any = None


class OakCamera(Camera):
    """One camera of an OAK.

    Args:
        settings: Settings of the camera. Images of another size are an error.
        build: Makes the pipeline from the depthai module and the settings, for a device or for a replay on the host.
        stamper: Converts and checks the stamps.
    """

    def __init__(
        self,
        settings: OakSource,
        build: Callable[[Any, OakSource], OakStream] | None = None,
        stamper: Stamper | None = None,
    ) -> None:
        self.settings = settings
        self._build = build or device_stream
        self._stamper = stamper or Stamper()
        self._stream: OakStream | None = None
        self._depthai: Any = None

    @property
    def pinhole(self) -> Pinhole | None:
        """Factory calibration at this size while the device is open; only for undistorted images."""
        return self._stream.pinhole if self._stream and self.settings.undistort else None

    def open(self) -> None:
        """Find the device, load the pipeline and start it."""
        self.close()
        self._depthai = _import_depthai()
        self._stream = self._build(self._depthai, self.settings)
        self._stamper.restart()
        try:
            self._stream.pipeline.start()
        except RuntimeError as error:
            self.close()
            raise LinkLost(f"cannot start the OAK: {error}; unplug it and plug it in again") from error

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest unread frame, or None after ``timeout_s``."""
        if self._stream is None:
            raise LinkLost("expected an open camera, but the OAK is not open; call open() first")
        try:
            message = self._stream.queue.get(datetime.timedelta(seconds=max(timeout_s, 0.0)))
        except (self._depthai.MessageQueue.QueueException, RuntimeError) as error:
            raise LinkLost(f"lost the OAK: {error}; unplugged, or not enough power?") from error
        if message is None:
            return None
        stamps = self._stamper.convert(self._stamp_ns(message))
        if stamps is None:
            return None
        return Frame(self._pixels(message), *stamps, int(message.getSequenceNum()))

    def close(self) -> None:
        """Stop the pipeline and release the device."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        with contextlib.suppress(RuntimeError):
            if stream.pipeline.isRunning():
                stream.pipeline.stop()
                stream.pipeline.wait()
        if stream.device is not None:
            with contextlib.suppress(RuntimeError):
                stream.device.close()

    def counters(self) -> dict[str, float]:
        """Counts of rejected stamps."""
        return {"stamps_replaced": self._stamper.replaced, "stamps_refused": self._stamper.refused}

    def _stamp_ns(self, message: Any) -> int:
        # The middle of the exposure, on std::chrono::steady_clock, which is CLOCK_MONOTONIC on Linux.
        stamp = message.getTimestamp(self._depthai.CameraExposureOffset.MIDDLE)
        return (stamp.days * 86_400 + stamp.seconds) * 1_000_000_000 + stamp.microseconds * 1000

    def _pixels(self, message: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
        bgr = message.getCvFrame()
        expected = (self.settings.height, self.settings.width, 3)
        if bgr is None or bgr.shape != expected:
            got = None if bgr is None else list(bgr.shape)
            raise ProtocolError(f"expected images {list(expected)} from the OAK, got {got}")
        rgb = np.array(bgr[:, :, ::-1], dtype=np.uint8, order="C")
        rgb.flags.writeable = False
        return rgb


def device_stream(depthai: Any, settings: OakSource) -> OakStream:
    """Make the pipeline of a real device: camera, undistortion, scaling, and one queue of length 1."""
    info = find_device(depthai, settings.device)
    try:
        device = depthai.Device(info)
    except RuntimeError as error:
        raise DeviceBusy(f"cannot open the OAK {info}: {error}; is another program using it?") from error
    try:
        board_socket = getattr(depthai.CameraBoardSocket, settings.socket, None)
        if board_socket is None or board_socket not in device.getConnectedCameras():
            has = ", ".join(socket.name for socket in device.getConnectedCameras())
            raise HardwareError(
                f"expected a camera on socket {settings.socket} of the OAK, got {has}; correct socket"
            )
        pipeline = depthai.Pipeline(device)
        camera = pipeline.create(depthai.node.Camera).build(board_socket)
        fix_controls(camera.initialControl, settings)
        output = camera.requestOutput(
            (settings.width, settings.height),
            depthai.ImgFrame.Type.BGR888i,
            fps=settings.fps,
            enableUndistortion=settings.undistort,
        )
        queue = output.createOutputQueue(maxSize=1, blocking=False)
        K = device.readCalibration().getCameraIntrinsics(board_socket, settings.width, settings.height)
        pinhole = Pinhole(settings.width, settings.height, K[0][0], K[1][1], K[0][2] + 0.5, K[1][2] + 0.5)
    except BaseException as error:
        device.close()
        if isinstance(error, RuntimeError) and not isinstance(error, HardwareError):
            raise HardwareError(f"the OAK refused {settings}: {error}; change these settings") from error
        raise
    return OakStream(pipeline, queue, pinhole, device)


def fix_controls(control: Any, settings: OakSource) -> None:
    """Write exposure and white balance to a ``depthai.CameraControl``."""
    if settings.exposure_us is not None:
        control.setManualExposure(settings.exposure_us, settings.iso or _ISO_DEFAULT)
    if settings.white_balance_k is not None:
        control.setManualWhiteBalance(settings.white_balance_k)


def find_device(depthai: Any, name: str) -> Any:
    """Find the device with this id or address, or the only one. `DeviceNotFound` lists the existing devices."""
    # depthai's own error for a missing device takes seconds and names no devices.
    found = depthai.Device.getAllAvailableDevices()
    chosen = [info for info in found if not name or name in (info.getDeviceId(), info.name)]
    there = ", ".join(f"{info.getDeviceId()} ({info.name})" for info in found) or "none"
    if len(chosen) == 1:
        return chosen[0]
    if chosen:
        raise DeviceNotFound(f"expected one OAK, found {there}; select one with 'device'")
    if name.count(".") == 3:
        # An OAK PoE in another network segment does not answer broadcasts, but can be opened by its address.
        return depthai.DeviceInfo(name)
    wanted = f"the OAK {name}" if name else "an OAK"
    raise DeviceNotFound(
        f"expected {wanted}, found {there}. Is it plugged in (USB 3 cable, enough power), and are Luxonis' udev rules installed"
        " (docs/cameras.md)?"
    )


def _import_depthai() -> Any:
    try:
        import depthai
    except ImportError as error:
        raise HardwareError(f"OAK cameras need depthai 3: pip install 'advnerf[oak]' ({error})") from error
    if int(depthai.__version__.split(".")[0]) != 3:
        raise HardwareError(f"expected depthai 3, got {depthai.__version__}: pip install 'advnerf[oak]'")
    return depthai
