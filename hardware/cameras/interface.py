"""What every camera does, whatever it is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Pinhole


@dataclass(frozen=True)
class Frame:
    """One picture with its time of capture.

    Attributes:
        rgb: Pixels ``[H, W, 3]`` uint8, not to be written to.
        stamp_realtime_ns: Capture in real time, as near to the exposure as the device can say [ns].
        stamp_mono_ns: The same instant in monotonic time [ns].
        sequence: Counts the device's frames; a gap means frames that were never delivered.
    """

    rgb: NDArray[np.uint8]
    stamp_realtime_ns: int
    stamp_mono_ns: int
    sequence: int


class Camera(Protocol):
    """A source of frames. `open` may be called again after an error; one thread at a time.

    Drivers derive from it and write `open`, `read` and `close`; the others have answers for a device that knows nothing more.
    """

    def open(self) -> None:
        """Start the device; raises `hardware.errors.DeviceNotFound` if it is not there."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Newest frame not read yet; None if none came in time; raises `hardware.errors.LinkLost` if the device went away."""
        ...

    def close(self) -> None:
        """Stop the device; harmless when it is not open."""
        ...

    @property
    def pinhole(self) -> Pinhole | None:
        """Intrinsics of the delivered pictures as the device itself knows them (factory calibration), once it is open."""
        return None

    def counters(self) -> dict[str, float]:
        """What went wrong with frames since the beginning, by name; it survives `open` and `close`."""
        return {}
