"""One photograph on disk, with its lens and pose from a data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Array, Pinhole


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One photograph on disk.

    Attributes:
        pinhole: Intrinsics for the listed size.
        lens: Distortion.
        T_world_from_camera: Pose ``[4, 4]``, OpenCV axes.
        mask: File whose black pixels are left out; None if all count.
        split: ``train``, ``val`` or ``test`` if the data set has splits.
    """

    path: Path
    pinhole: Pinhole
    lens: Lens
    T_world_from_camera: Array
    mask: Path | None = None
    camera_id: str = ""
    split: str | None = None
