"""Keeps a camera running: opens it, detects stalls and repeated images, and reopens it with growing pauses."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable

from hardware.cameras.interface import Camera, Frame
from hardware.errors import HardwareError


class SteadyCamera:
    """Reads a camera that may be absent at first, or disconnect and return. Used by one thread, the read thread.

    Args:
        stall_s: Time without a frame after which it is reopened [s].
        first_frame_s: The same time for the first frame after opening [s].
        repeats: Number of identical images in a row that count as a stall, but for simulated ones; 0 for never. Sensor noise makes real images
            differ, so that each is withheld: the car must not steer by it for as long as it takes to count them.
        pauses_s: First and longest pause before another attempt, doubled each time [s].

    Attributes:
        error: Current error; empty while frames arrive.
        is_open: Whether the device is open.
    """

    def __init__(
        self,
        camera: Camera,
        stall_s: float = 1.0,
        first_frame_s: float = 5.0,
        repeats: int = 0,
        pauses_s: tuple[float, float] = (0.3, 2.0),
        now_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.camera = camera
        self.error = "not connected yet"
        self._stall_s, self._first_frame_s, self._repeats = stall_s, first_frame_s, repeats
        self._pauses_s, self._now_s, self._sleep = pauses_s, now_s, sleep
        self.is_open = False
        self._pause_s = pauses_s[0]
        self._try_s = -1.0
        self._deadline_s = 0.0
        self._digest, self._same = 0, 0
        self._opened = self._stalls = 0

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame, or None. After an error, `error` is set and a later call reconnects."""
        if (wait_s := self._try_s - self._now_s()) > 0.0:
            self._sleep(min(wait_s, timeout_s))
            return None
        try:
            if not self.is_open:
                self._open()
            frame = self.camera.read(timeout_s)
            self._watch(frame)
            return None if self._same else frame
        except HardwareError as error:
            self._give_up(str(error))
            return None

    def close(self) -> None:
        """Stop the device."""
        self.camera.close()
        self.is_open = False

    def counters(self) -> dict[str, float]:
        """Counts of reopenings and stalls, and the counters of the driver."""
        own = {"camera_reopened": max(self._opened - 1, 0), "camera_stalls": self._stalls}
        return {**own, **self.camera.counters()}

    def _open(self) -> None:
        self.camera.open()
        self.is_open = True
        self._opened += 1
        self._same = 0
        self._deadline_s = self._now_s() + self._first_frame_s

    def _watch(self, frame: Frame | None) -> None:
        now_s = self._now_s()
        if frame is not None:
            self.error, self._pause_s = "", self._pauses_s[0]
            self._deadline_s = now_s + self._stall_s
            self._watch_repeats(frame)
        elif now_s > self._deadline_s:
            self._stalls += 1
            waited_s = self._first_frame_s if self.error else self._stall_s
            raise HardwareError(f"the camera is connected but gave no frame for {waited_s:g} s; reopening it")

    def _watch_repeats(self, frame: Frame) -> None:
        if self._repeats == 0 or frame.simulated:
            self._same = 0
            return
        digest = zlib.crc32(frame.rgb.data)
        self._same = self._same + 1 if digest == self._digest else 0
        self._digest = digest
        if self._same >= self._repeats:
            self._stalls += 1
            raise HardwareError(
                f"the camera repeats one image ({self._same + 1} identical frames); reopening it. If the scene is dark, simulated or"
                " recorded, disable this check with repeats: 0"
            )

    def _give_up(self, error: str) -> None:
        self.camera.close()
        self.is_open, self.error = False, error
        self._try_s = self._now_s() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, self._pauses_s[1])
