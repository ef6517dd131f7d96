"""Calibration files of lens and time offset."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Array
from calibration.schema import Calibration, Intrinsics, Row4


class LensCalibration(Intrinsics):
    """A camera's lens, without its pose on the car."""

    kind: Literal["lens"] = "lens"

    @property
    def lens(self) -> Lens:
        """Distortion."""
        return Lens(self.distortion)


class TimeOffsetCalibration(Calibration):
    """Delay of camera stamps relative to motion-capture stamps.

    Attributes:
        camera_minus_mocap_s: Camera stamp less mocap stamp of the same instant [s]; the camera's ``latency_s`` subtracts it.
        stddev_s: Standard deviation of the offset from the residuals [s].
    """

    kind: Literal["time_offset"] = "time_offset"
    camera_minus_mocap_s: float
    stddev_s: float = Field(ge=0.0)


def rows_of(T: Array) -> tuple[Row4, Row4, Row4, Row4]:
    """A transform ``[4, 4]`` from a file's rows, with an orthogonal rotation."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    clean = np.eye(4)
    clean[:3, :3], clean[:3, 3] = u @ vt, T[:3, 3]
    a, b, c, d = (tuple(float(v) for v in row) for row in clean)
    return a, b, c, d  # type: ignore[return-value]
