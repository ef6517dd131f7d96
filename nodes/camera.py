"""The camera node: publishes every frame when it arrives, with its capture time as the stamp."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from pydantic import Field

from advnerf_core.geometry import Pinhole
from advnerf_core.strict import StrictModel
from calibration.schema import CameraCalibration, load_calibration
from hardware.cameras.interface import Frame
from hardware.cameras.sources import CameraSource
from hardware.cameras.stamping import Decimator
from hardware.cameras.steady import SteadyCamera
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.messages import camera_info_message, image_message
from nodes.runtime.node import (
    ACTIVE,
    FAULT,
    STARTING,
    Inbox,
    Node,
    NodeContext,
    Now,
    Out,
    ReaderThread,
)
from nodes.runtime.pictures import COMPRESSED_TOPIC, RAW_TOPIC, compressed_image_message
from nodes.runtime.process import run_node_main

_READ_TIMEOUT_S = 0.2
# Largest relative difference from the factory's focal length, and of the principal point as a fraction of the image size.
_FACTORY_TOLERANCE = 0.05
FRAME_ID = "camera"


class CompressedConfig(StrictModel):
    """JPEG images for a wireless link.

    Attributes:
        rate_hz: Highest rate of images [Hz].
        quality: JPEG quality, 1 to 100.
    """

    rate_hz: float = Field(default=10.0, gt=0.0)
    quality: int = Field(default=80, ge=1, le=100)


class CameraNodeConfig(StrictModel):
    """Configuration of the camera node.

    Attributes:
        source: Device with ``kind`` v4l2, zed, oak, socket, file, folder, an entry point or ``file.py:Class``; see
            `hardware.cameras.sources` and `hardware.cameras.foreign`.
        calibration: Camera calibration file. Frames of another size are refused.
        max_age_s: Largest age of a frame on arrival; older frames are not published [s].
        silence_s: Time without a frame after which the node reports a fault [s].
        compressed: Also publish JPEG images on ``/camera/image_raw/compressed`` while the topic has subscribers.
    """

    source: CameraSource
    calibration: Path
    max_age_s: float = Field(default=0.2, gt=0.0)
    silence_s: float = Field(default=0.5, gt=0.0)
    compressed: CompressedConfig | None = None


class CameraNode(Node):
    """Publishes frames as images and camera infos."""

    opens = "a camera"

    def __init__(
        self,
        config: CameraNodeConfig,
        calibration: CameraCalibration,
        subscribers: Callable[[str], int] = lambda topic: 0,
        device: SteadyCamera | None = None,
    ) -> None:
        self._config = config
        self._calibration = calibration
        self.publications = (
            RAW_TOPIC,
            "/camera/camera_info",
            *((COMPRESSED_TOPIC,) if config.compressed else ()),
        )
        self._subscribers = subscribers
        if config.compressed is not None:
            # A frame may arrive up to a quarter of a period early.
            self._grid = Decimator(config.compressed.rate_hz, 2.0 * config.compressed.rate_hz)
        self._device = device or config.source.steady()
        self._factory: Pinhole | None = None
        # Two: the newest frame, and the one that the loop is taking.
        self.inbox: Inbox[Frame] = Inbox(capacity=2)
        self._reader = ReaderThread(partial(self._device.read, _READ_TIMEOUT_S), self.inbox, "camera")
        self._sequence: int | None = None
        self._arrived_ns: int | None = None
        self._now_ns = time.monotonic_ns
        self._stale = self._missed = 0

    @classmethod
    def build(cls, config: CameraNodeConfig, context: NodeContext) -> CameraNode:
        """Build the node and start reading frames."""
        node = cls(config, load_calibration(CameraCalibration, config.calibration), context.subscribers)
        node._now_ns = lambda: context.clock.now().mono_ns
        node._reader.start()
        return node

    def receive(self, item: Frame, now: Now) -> list[Out]:
        """Publish a frame."""
        expected = (self._calibration.height, self._calibration.width)
        if item.rgb.shape[:2] != expected:
            raise RuntimeFault(
                f"expected frames of {expected[1]} x {expected[0]} as in {self._config.calibration}, got"
                f" {item.rgb.shape[1]} x {item.rgb.shape[0]}; calibrate this mode, or set the camera to the calibrated one"
            )
        if (now.mono_ns - item.stamp_mono_ns) / NS_PER_S > self._config.max_age_s:
            self._stale += 1  # the frame waited while this process was held up
            return []
        self._require_this_camera()
        self._count_missed(item)
        self._arrived_ns = now.mono_ns
        stamp_ns = item.stamp_realtime_ns - round(self._calibration.latency_s * NS_PER_S)
        info = camera_info_message(
            self._calibration.pinhole, stamp_ns, FRAME_ID, self._calibration.distortion
        )
        outs = [Out(RAW_TOPIC, image_message(item.rgb, stamp_ns, FRAME_ID)), Out("/camera/camera_info", info)]
        return outs + self._compressed(item, stamp_ns)

    def status(self) -> tuple[str, str]:
        """Report a fault if frames have stopped."""
        if self._arrived_ns is None:
            return STARTING, self._device.error or "waiting for the first frame"
        silence_s = (self._now_ns() - self._arrived_ns) / NS_PER_S
        if silence_s > self._config.silence_s:
            return FAULT, self._device.error or f"no frame for {silence_s:.1f} s"
        return ACTIVE, ""

    def counters(self) -> dict[str, float]:
        """Report frames that were not published, and the counters of the device."""
        return {"frames_stale": self._stale, "frames_missed": self._missed, **self._device.counters()}

    def close(self) -> None:
        """Stop reading."""
        self._reader.stop()
        self._device.close()

    def _compressed(self, frame: Frame, stamp_ns: int) -> list[Out]:
        """Encode a frame as JPEG with the same stamp. Empty without subscribers, or if the frame is too early for the rate."""
        wanted = self._config.compressed
        if (
            wanted is None
            or not self._subscribers(COMPRESSED_TOPIC)
            or self._grid.slot(frame.stamp_mono_ns) is None
        ):
            return []
        return [
            Out(COMPRESSED_TOPIC, compressed_image_message(frame.rgb, stamp_ns, FRAME_ID, wanted.quality))
        ]

    def _require_this_camera(self) -> None:
        """Compare the calibration with the device's factory calibration, if it has one, to detect the file of another camera."""
        factory = self._device.camera.pinhole
        if factory is None or factory == self._factory:
            return
        ours = self._calibration.pinhole
        focal = max(abs(ours.fx / factory.fx - 1.0), abs(ours.fy / factory.fy - 1.0))
        centre = max(abs(ours.cx - factory.cx) / factory.width, abs(ours.cy - factory.cy) / factory.height)
        if max(focal, centre) > _FACTORY_TOLERANCE:
            raise RuntimeFault(
                f"{self._config.calibration} has fx {ours.fx:.1f}, cx {ours.cx:.1f}, cy {ours.cy:.1f}, but the device's factory"
                f" calibration has fx {factory.fx:.1f}, cx {factory.cx:.1f}, cy {factory.cy:.1f}: it is the file of another camera or"
                " mode; calibrate this one"
            )
        self._factory = factory

    def _count_missed(self, frame: Frame) -> None:
        if self._sequence is not None and frame.sequence > self._sequence:
            self._missed += frame.sequence - self._sequence - 1
        self._sequence = frame.sequence


if __name__ == "__main__":
    raise SystemExit(run_node_main(CameraNodeConfig, CameraNode.build))
