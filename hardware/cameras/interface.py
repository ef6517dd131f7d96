"""The interface of all cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Pinhole

RECORDED = "recorded"
"""Counter of a camera whose frames are recorded: the safety node lets only the simulated car drive by them."""


@dataclass(frozen=True)
class Frame:
    """An image with its capture time.

    Attributes:
        rgb: Pixels ``[H, W, 3]`` uint8, read-only.
        stamp_realtime_ns: Capture time in real time, as close to the exposure as the device can report [ns].
        stamp_mono_ns: The same time on the monotonic clock [ns].
        sequence: Frame number of the device. A gap means frames that were not delivered.
        simulated: It is an image of the simulated lab, where a car that stands sees the same pixels again: no sign of a frozen camera.
    """

    rgb: NDArray[np.uint8]
    stamp_realtime_ns: int
    stamp_mono_ns: int
    sequence: int
    simulated: bool = False


class Camera(Protocol):
    """A source of frames. `open` may be called again after an error. Only one thread at a time may use it.

    Drivers derive from it and implement `open`, `read` and `close`. The other members have defaults.
    """

    def open(self) -> None:
        """Start the device. Raises `hardware.errors.DeviceNotFound` if it does not exist."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest unread frame; None on timeout. Raises `hardware.errors.LinkLost` if the device is lost."""
        ...

    def close(self) -> None:
        """Stop the device. Does nothing if it is not open."""
        ...

    @property
    def pinhole(self) -> Pinhole | None:
        """Intrinsics of the delivered images from the device's factory calibration, once it is open; None if unknown."""
        return None

    def counters(self) -> dict[str, float]:
        """Error counters of frames by name, kept across `open` and `close`; and `RECORDED` where they are no view of now."""
        return {}
