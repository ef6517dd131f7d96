"""Keeps any camera going: opens it, notices when it stalls or repeats itself, and opens it again with growing pauses."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable

from hardware.cameras.interface import Camera, Frame
from hardware.errors import HardwareError


class SteadyCamera:
    """Reads a camera that may not be there yet, or may go away and come back. Lives in one thread, the read thread.

    Args:
        camera: The device.
        stall_s: Time without a frame after which it is closed and opened anew [s].
        first_frame_s: The same for the first frame after it was opened [s].
        repeats: Identical pictures in a row that count as a stall, which the noise of a real sensor never makes; 0 for never.
        pauses_s: First and longest pause before another try [s]; each is twice the one before.
        now_s: Monotonic time [s].
        sleep: Waits [s].

    Attributes:
        error: What is wrong at present; empty while frames come.
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
        self._is_open = False
        self._pause_s = pauses_s[0]
        self._try_s = -1.0
        self._deadline_s = 0.0
        self._digest, self._same = 0, 0
        self._opened = self._stalls = 0

    def read(self, timeout_s: float) -> Frame | None:
        """Newest frame, or None; what goes wrong is in `error` and is put right by a later call."""
        if (wait_s := self._try_s - self._now_s()) > 0.0:
            self._sleep(min(wait_s, timeout_s))
            return None
        try:
            if not self._is_open:
                self._open()
            frame = self.camera.read(timeout_s)
            self._watch(frame)
            return frame
        except HardwareError as error:
            self._give_up(str(error))
            return None

    def close(self) -> None:
        """Stop the device."""
        self.camera.close()
        self._is_open = False

    def counters(self) -> dict[str, float]:
        """How often it was opened again, how often because it stalled, and what the driver counts."""
        own = {"camera_reopened": max(self._opened - 1, 0), "camera_stalls": self._stalls}
        return {**own, **self.camera.counters()}

    def _open(self) -> None:
        self.camera.open()
        self._is_open = True
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
            raise HardwareError(f"the camera is there but gave no frame for {waited_s:g} s; it is opened anew")

    def _watch_repeats(self, frame: Frame) -> None:
        if self._repeats == 0:
            return
        digest = zlib.crc32(frame.rgb.data)
        self._same = self._same + 1 if digest == self._digest else 0
        self._digest = digest
        if self._same >= self._repeats:
            self._stalls += 1
            raise HardwareError(
                f"the camera repeats one picture ({self._same + 1} identical frames); it is opened anew. If it looks into the"
                " dark, or at a recording, switch this check off by repeats: 0"
            )

    def _give_up(self, error: str) -> None:
        self.camera.close()
        self._is_open, self.error = False, error
        self._try_s = self._now_s() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, self._pauses_s[1])
