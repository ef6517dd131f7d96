"""The state of an emulated video device: modes, controls, buffers, and methods that expose frames and unplug it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

_BYTES_PER_PIXEL = {"YUYV": 2.0, "UYVY": 2.0, "YVYU": 2.0, "GREY": 1.0, "NV12": 1.0, "RGB3": 3.0, "BGR3": 3.0}
AUTO_EXPOSURE, EXPOSURE, EXPOSURE_PRIORITY = 0x009A0901, 0x009A0902, 0x009A0903
AUTO_WHITE_BALANCE, WHITE_BALANCE, GAIN, BRIGHTNESS = 0x0098090C, 0x0098091A, 0x00980913, 0x00980900


@dataclass
class ControlState:
    """One control of a device.

    Attributes:
        minimum: Smallest value.
        maximum: Greatest value.
        step: Values are rounded down to a multiple of it.
        value: Current value.
        stuck: Whether it accepts new values but keeps its own.
    """

    minimum: int
    maximum: int
    step: int
    value: int
    stuck: bool = False


def webcam_controls() -> dict[int, ControlState]:
    """Controls of a usual USB webcam, with its automatic modes on."""
    return {
        AUTO_EXPOSURE: ControlState(0, 3, 1, 3),
        EXPOSURE: ControlState(3, 2047, 1, 250),
        EXPOSURE_PRIORITY: ControlState(0, 1, 1, 1),
        AUTO_WHITE_BALANCE: ControlState(0, 1, 1, 1),
        WHITE_BALANCE: ControlState(2000, 6500, 10, 4000),
        GAIN: ControlState(0, 255, 1, 64),
        BRIGHTNESS: ControlState(0, 255, 1, 128),
    }


@dataclass
class FrameBuffer:
    """A buffer and the data that the device has written to it."""

    memory: bytearray
    used: int = 0
    flags: int = 0
    stamp_ns: int = 0
    sequence: int = 0


@dataclass
class VideoDevice:
    """One device of the emulator; frames come when `expose` is called.

    Attributes:
        formats: Sizes by pixel format.
        rates: Supported frame rates [Hz].
        metadata_only: Whether this is the second device of a webcam, which delivers no pictures.
        padding_bytes: Unused bytes at the end of every row.
        after_start: Changes that the device applies to itself when the stream starts.
        extension: Answers requests to the extension units of a UVC device: unit, selector, query, data.
    """

    formats: dict[str, list[tuple[int, int]]] = field(
        default_factory=lambda: {"YUYV": [(640, 480), (320, 240)]}
    )
    rates: tuple[float, ...] = (30.0, 15.0)
    controls: dict[int, ControlState] = field(default_factory=webcam_controls)
    metadata_only: bool = False
    padding_bytes: int = 0
    after_start: Callable[[VideoDevice], None] | None = None
    extension: Callable[[int, int, int, bytearray], None] | None = None
    card: str = "Emulated Camera"

    def __post_init__(self) -> None:
        self.condition = threading.Condition()
        self.there = True
        self.owner: int | None = None
        self.pixel_format = next(iter(self.formats))
        self.width, self.height = self.formats[self.pixel_format][0]
        self.rate = self.rates[0]
        self.reset()

    def reset(self) -> None:
        """Forget buffers and stream, as after the last user has left."""
        self.streaming = False
        self.sequence = 0
        self.buffers: list[FrameBuffer] = []
        self.queued: deque[int] = deque()
        self.done: deque[int] = deque()

    @property
    def row_bytes(self) -> int:
        """Bytes from one row to the next; 0 for compressed formats."""
        per_pixel = _BYTES_PER_PIXEL.get(self.pixel_format)
        return 0 if per_pixel is None else int(self.width * per_pixel) + self.padding_bytes

    @property
    def picture_bytes(self) -> int:
        """Size of a picture's buffer."""
        rows = self.height * 3 // 2 if self.pixel_format == "NV12" else self.height
        return rows * self.row_bytes or self.width * self.height * 2

    def expose(self, data: bytes, stamp_ns: int | None = None, damaged: bool = False) -> None:
        """Expose one frame; it is lost, with its number, if no buffer is queued."""
        with self.condition:
            if not (self.there and self.streaming):
                return
            sequence, self.sequence = self.sequence, self.sequence + 1
            if not self.queued:
                return
            index = self.queued.popleft()
            buffer = self.buffers[index]
            buffer.memory[: len(data)] = data
            buffer.used, buffer.sequence = len(data), sequence
            buffer.stamp_ns = time.monotonic_ns() if stamp_ns is None else stamp_ns
            buffer.flags = 0x12000 | (0x40 if damaged else 0)  # the stamp: monotonic, start of exposure
            self.done.append(index)
            self.condition.notify_all()

    def unplug(self) -> None:
        """Pull the cable."""
        with self.condition:
            self.there = False
            self.reset()
            self.condition.notify_all()

    def plug(self) -> None:
        """Plug the cable in again; the device has forgotten its settings."""
        with self.condition:
            self.reset()
            self.owner = None
            self.there = True
