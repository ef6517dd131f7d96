"""The camera node: publishes every frame the moment it arrives, under the time at which it was taken."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from calibration.schema import CameraCalibration, load_calibration
from hardware.cameras.file import FileCamera
from hardware.cameras.interface import Camera, Frame
from hardware.cameras.socket import SocketCamera
from hardware.errors import HardwareError
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.messages import camera_info_message, image_message
from nodes.runtime.node import (
    ACTIVE,
    FAULT,
    STARTING,
    Inbox,
    MessageInfo,
    Node,
    NodeContext,
    Now,
    Out,
    ReaderThread,
    run_node_main,
)

_READ_TIMEOUT_S = 0.2
_RETRY_S = 0.3
FRAME_ID = "camera"


class SocketSource(BaseModel):
    """Frames from a Unix socket.

    Attributes:
        kind: ``socket``.
        path: Path of the socket; ``${socket_dir}/frames`` for the twin.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["socket"] = "socket"
    path: Path

    def camera(self) -> Camera:
        """The device."""
        return SocketCamera(self.path)


class FileSource(BaseModel):
    """Recorded pictures.

    Attributes:
        kind: ``file``.
        folder: Folder of numbered images.
        rate_hz: Frames per second.
        loop: Begin again after the last one.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["file"] = "file"
    folder: Path
    rate_hz: float = Field(default=10.0, gt=0.0)
    loop: bool = True

    def camera(self) -> Camera:
        """The device."""
        return FileCamera(self.folder, self.rate_hz, self.loop)


class CameraConfig(BaseModel):
    """Configuration of the camera node.

    Attributes:
        source: Device: ``kind: socket`` or ``kind: file``.
        calibration: Camera calibration file; frames of another size are refused.
        max_age_s: A frame older than this when it arrives is not published [s].
        silence_s: Time without a frame after which the node reports a fault [s].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: Annotated[SocketSource | FileSource, Field(discriminator="kind")]
    calibration: Path
    max_age_s: float = Field(default=0.2, gt=0.0)
    silence_s: float = Field(default=0.5, gt=0.0)


class _Reconnecting:
    """Reads a camera that may not be there yet, or may go away and come back; lives in the reader's thread."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._is_open = False
        self.error = "not connected yet"

    def read(self) -> Frame | None:
        try:
            if not self._is_open:
                self._camera.open()
                self._is_open, self.error = True, ""
            return self._camera.read(_READ_TIMEOUT_S)
        except HardwareError as error:
            self._camera.close()
            self._is_open, self.error = False, str(error)
            time.sleep(_RETRY_S)
            return None

    def close(self) -> None:
        self._camera.close()


class CameraNode(Node):
    """Turns frames into images and camera infos."""

    publications = ("/camera/image_raw", "/camera/camera_info")

    def __init__(self, config: CameraConfig, calibration: CameraCalibration) -> None:
        self._config = config
        self._calibration = calibration
        self._device = _Reconnecting(config.source.camera())
        # Two: the newest, and the one that may just be taken.
        self.inbox: Inbox[Frame] = Inbox(capacity=2)
        self._reader = ReaderThread(self._device.read, self.inbox, "camera")
        self._sequence: int | None = None
        self._arrived_ns: int | None = None
        self._now_ns = time.monotonic_ns
        self._stale = self._missed = 0

    @classmethod
    def build(cls, config: CameraConfig, context: NodeContext) -> CameraNode:
        """Make the node of a process and begin to read."""
        node = cls(config, load_calibration(CameraCalibration, config.calibration))
        node._now_ns = lambda: context.clock.now().mono_ns
        node._reader.start()
        return node

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """It listens to nobody."""
        return []

    def receive(self, item: Frame, now: Now) -> list[Out]:
        """Publish a frame."""
        expected = (self._calibration.height, self._calibration.width)
        if item.rgb.shape[:2] != expected:
            raise RuntimeFault(
                f"expected frames of {expected[1]} x {expected[0]} as in {self._config.calibration}, got"
                f" {item.rgb.shape[1]} x {item.rgb.shape[0]}: calibrate this mode, or set the camera to the calibrated one"
            )
        if (now.mono_ns - item.stamp_mono_ns) / NS_PER_S > self._config.max_age_s:
            self._stale += 1  # left over from a time when this process was held up
            return []
        self._count_missed(item)
        self._arrived_ns = now.mono_ns
        stamp_ns = item.stamp_realtime_ns - round(self._calibration.latency_s * NS_PER_S)
        info = camera_info_message(self._calibration.pinhole, stamp_ns, FRAME_ID, self._calibration.distortion)
        return [
            Out("/camera/image_raw", image_message(item.rgb, stamp_ns, FRAME_ID)),
            Out("/camera/camera_info", info),
        ]

    def status(self) -> tuple[str, str]:
        """Fault when frames have ceased."""
        if self._arrived_ns is None:
            return STARTING, self._device.error or "waiting for the first frame"
        silence_s = (self._now_ns() - self._arrived_ns) / NS_PER_S
        if silence_s > self._config.silence_s:
            return FAULT, self._device.error or f"no frame for {silence_s:.1f} s"
        return ACTIVE, ""

    def counters(self) -> dict[str, float]:
        """Frames that were not published."""
        return {"frames_stale": self._stale, "frames_missed": self._missed}

    def close(self) -> None:
        """Stop reading."""
        self._reader.stop()
        self._device.close()

    def _count_missed(self, frame: Frame) -> None:
        if self._sequence is not None and frame.sequence > self._sequence:
            self._missed += frame.sequence - self._sequence - 1
        self._sequence = frame.sequence


def main() -> int:
    """Run the node as a process."""
    return run_node_main(CameraConfig, CameraNode.build)


if __name__ == "__main__":
    raise SystemExit(main())
