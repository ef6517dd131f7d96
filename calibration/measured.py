"""Calibration files of lens, scene pose in the motion-capture world, and time offset."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from advnerf_core.data.lens import Lens
from advnerf_core.data.similarity import Similarity
from advnerf_core.geometry import Array, Pinhole
from calibration.schema import Calibration, Row4, require_rigid


class LensCalibration(Calibration):
    """A camera's lens, without its pose on the car.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        fx: Focal length [px].
        fy: Focal length [px].
        cx: Principal point, pixel centres at +0.5 [px].
        cy: Principal point, pixel centres at +0.5 [px].
        distortion: OpenCV's k1, k2, p1, p2, k3.
        rms_px: Reprojection error of the fit [px].
    """

    kind: Literal["lens"] = "lens"
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0.0)
    fy: float = Field(gt=0.0)
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rms_px: float | None = Field(default=None, ge=0.0)

    @property
    def pinhole(self) -> Pinhole:
        """Intrinsics."""
        return Pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def lens(self) -> Lens:
        """Distortion."""
        return Lens(self.distortion)


class SceneCalibration(Calibration):
    """Pose and scale of a scene in the motion-capture world: ``world = scale R scene + t``.

    Attributes:
        scale: Metres per unit of the scene.
        T_world_from_scene: The rigid part ``R``, ``t`` [m].
    """

    kind: Literal["mocap_to_scene"] = "mocap_to_scene"
    scale: float = Field(gt=0.0)
    T_world_from_scene: tuple[Row4, Row4, Row4, Row4]

    @field_validator("T_world_from_scene")
    @classmethod
    def _rigid(cls, rows: tuple[Row4, ...]) -> tuple[Row4, ...]:
        return require_rigid(rows)

    @property
    def similarity(self) -> Similarity:
        """The map from scene to world."""
        return Similarity(self.scale, np.array(self.T_world_from_scene))


class TimeOffsetCalibration(Calibration):
    """Delay of camera stamps relative to motion-capture stamps.

    Attributes:
        camera_minus_mocap_s: Camera stamp less mocap stamp of the same instant [s]; what ``latency_s`` of the camera takes off.
        stddev_s: Standard deviation of that by the residuals [s].
    """

    kind: Literal["time_offset"] = "time_offset"
    camera_minus_mocap_s: float
    stddev_s: float = Field(ge=0.0)


def rows_of(T: Array) -> tuple[Row4, Row4, Row4, Row4]:
    """A transform ``[4, 4]`` as a file holds it, its rotation made orthogonal to the last bit that matters."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    clean = np.eye(4)
    clean[:3, :3], clean[:3, 3] = u @ vt, T[:3, 3]
    a, b, c, d = (tuple(float(v) for v in row) for row in clean)
    return a, b, c, d  # type: ignore[return-value]
