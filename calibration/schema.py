"""Schemas of the calibration files: one small dated YAML file per object, strictly validated.

Every file says what it is (``kind``), when and how it was measured. The twin's files have the method "by construction". Distances
are in metres, angles in radians, transforms ``T_a_from_b`` as four rows.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, field_validator, model_validator

from advnerf_core.documents import Document, decode_text, dump_yaml, parse_yaml, read_yaml
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.errors import AdvnerfError, ConfigError, MissingFileError
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array, Pinhole, require_camera
from advnerf_core.strict import (
    Angle,
    AngularRate,
    LagS,
    LengthM,
    RightAngleRad,
    SpeedMps,
    StrictModel,
    at_most,
    validate,
    within_a_turn,
)
from calibration.fence import inside, require_simple
from hardware.motor.limits import DriveLimits, VehicleGains

Row4 = tuple[float, float, float, float]
Point3 = tuple[float, float, float]
Point2 = tuple[float, float]
_RIGID_TOLERANCE = 1e-6
_PLANAR_TOLERANCE_M = 0.005
_LARGEST_FACE_M = 20.0  # a billboard of 14 x 48 feet has 15 m
_FURTHEST_FACE_M = 20.0  # from the origin of its subject, whose markers are on it or beside it
# Of a driving camera: the rear axle of a lorry is not further away, and one whose axis is turned by more looks at no road.
_FURTHEST_CAMERA_M, _LEAST_AHEAD = 5.0, 0.5
_LONGEST_WHEELBASE_M, _MOST_LATENCY_S = 8.0, 1.0
_SKEW = 0.1
# Of a fence to the extent of the path: a room is not that much larger.
_MOST_ROOM = 25.0
CORNERS = ("top left", "top right", "bottom right", "bottom left")
"""Order of a face's corners, as seen from the front."""
BY_CONSTRUCTION = "by construction"
"""Method of the simulated car's files, which nobody measured."""
_OPTIONAL = ("views", "residuals", "response")


class CalibrationError(AdvnerfError, ValueError):
    """A calibration file is missing or wrong."""


class Calibration(StrictModel):
    """Fields that all calibration files have.

    Attributes:
        kind: Kind of the calibration.
        date: Day of the measurement.
        method: Measuring method.
        notes: Remarks for people.
        views: Number of pictures, segments or samples behind the result; None without a fit.
        residuals: Residuals of the fit, by name with the unit; empty without a fit.
    """

    kind: str
    date: datetime.date
    method: str = Field(min_length=1)
    notes: str = ""
    views: int | None = Field(default=None, ge=0)
    residuals: dict[str, float] = Field(default_factory=dict)


def require_rigid(rows: tuple[Row4, ...]) -> tuple[Row4, ...]:
    """The rows of a transform ``[4, 4]``, or a `ValueError` that says what is wrong with them."""
    T = np.array(rows)
    R = T[:3, :3]
    error = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max())
    if error > _RIGID_TOLERANCE or np.linalg.det(R) < 0.0:
        raise ValueError(
            f"expected a rotation and a translation with last row 0 0 0 1, is off by {error:.1e}"
        )
    return rows


class Intrinsics(Calibration):
    """A lens in front of a sensor.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        fx: Focal length [px].
        fy: Focal length [px].
        cx: Principal point, pixel centres at +0.5 [px].
        cy: Principal point, pixel centres at +0.5 [px].
        distortion: OpenCV's k1, k2, p1, p2, k3.
        rms_px: Reprojection error of the fit [px]; None where nothing was fitted.
    """

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0.0)
    fy: float = Field(gt=0.0)
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rms_px: float | None = Field(default=None, ge=0.0)

    @model_validator(mode="after")
    def _of_a_camera(self) -> Intrinsics:
        require_camera(self.pinhole)
        return self

    @property
    def pinhole(self) -> Pinhole:
        """Intrinsics."""
        return Pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)


class CameraCalibration(Intrinsics):
    """A camera on the car.

    Attributes:
        T_car_from_camera: Mounting pose, OpenCV camera axes.
        latency_s: From exposure to the stamp, measured; subtracted by the camera node [s].
    """

    kind: Literal["camera"] = "camera"
    T_car_from_camera: tuple[Row4, Row4, Row4, Row4]
    latency_s: Annotated[float, at_most(_MOST_LATENCY_S, "s", "ms")] = 0.0

    @field_validator("T_car_from_camera")
    @classmethod
    def _rigid(cls, rows: tuple[Row4, ...]) -> tuple[Row4, ...]:
        if max(abs(row[3]) for row in rows) > _FURTHEST_CAMERA_M:
            raise ValueError(
                f"expected a camera at most {_FURTHEST_CAMERA_M:g} m from the rear axle; is it in cm or mm?"
            )
        return require_rigid(rows)

    @property
    def mount(self) -> Array:
        """``T_car_from_camera`` as an array ``[4, 4]``.

        Raises:
            CalibrationError: The camera does not look ahead, upright, as one that nobody measured, or one with other axes.
        """
        rows = self.T_car_from_camera
        # The camera's z axis looks into the picture, its y axis down (OpenCV); the car's x axis points ahead, its z axis up.
        if rows[0][2] < _LEAST_AHEAD or rows[2][1] > -_LEAST_AHEAD:
            raise CalibrationError(
                "T_car_from_camera: expected a camera that looks ahead, upright, with OpenCV's axes (x right, y down, z forward): column 3 of the "
                f"rotation near 1 0 0 and column 2 near 0 0 -1; got {_column(rows, 2)} and {_column(rows, 1)}"
            )
        return np.array(rows)


def _column(rows: tuple[Row4, ...], number: int) -> str:
    return " ".join(f"{row[number]:.2f}" for row in rows[:3])


class GainsSection(StrictModel):
    """See `hardware.motor.limits.VehicleGains`."""

    erpm_per_mps: float
    erpm_offset: float
    servo_per_rad: float
    servo_offset: float
    servo_min: float
    servo_max: float


class LimitsSection(StrictModel):
    """See `hardware.motor.limits.DriveLimits`."""

    speed_min_mps: SpeedMps
    speed_max_mps: SpeedMps
    steering_min_rad: RightAngleRad
    steering_max_rad: RightAngleRad
    acceleration_mps2: Annotated[float, at_most(100.0, "m/s^2", "cm/s^2")]
    steering_rate_radps: AngularRate
    current_max_a: Annotated[float, at_most(1000.0, "A", "mA")] = Field(default=60.0, gt=0.0)


class ResponseSection(StrictModel):
    """Delay and lag of the car.

    Attributes:
        pipeline_delay_s: Mean time from the capture of an image to the command written for it [s].
        steering_delay_s: Time from the written command until the wheels begin to move [s].
        steering_lag_s: Time constant of the wheel angle [s].
        steering_slew_radps: Greatest rate of the wheel angle [rad/s]; None if the commands never reached it.
        speed_delay_s: Time from the written command until the speed begins to change [s].
        speed_lag_s: Time constant of the speed [s].
    """

    pipeline_delay_s: LagS = Field(ge=0.0)
    steering_delay_s: LagS = Field(ge=0.0)
    steering_lag_s: LagS = Field(ge=0.0)
    steering_slew_radps: AngularRate | None = Field(default=None, gt=0.0)
    speed_delay_s: LagS = Field(ge=0.0)
    speed_lag_s: LagS = Field(ge=0.0)

    def attack_dynamics(self, driver_radps: float) -> dict[str, float]:
        """The section ``response`` of an attack: delay from image to wheels, lag, and the slower rate of the wheels and of the motor node.

        Args:
            driver_radps: Limit of the motor node, ``limits.steering_rate_radps``: commands in a bag are those before it [rad/s].
        """
        wheels_radps = driver_radps if self.steering_slew_radps is None else self.steering_slew_radps
        return {
            "delay_s": round(self.pipeline_delay_s + self.steering_delay_s, 4),
            "lag_s": round(self.steering_lag_s, 4),
            "slew_radps": round(min(wheels_radps, driver_radps), 3),
        }


class VehicleCalibration(Calibration):
    """The car.

    Attributes:
        wheelbase_m: Distance between the axles [m].
        gains: Conversion of speed and steering to the motor controller's units.
        limits: Limits of the sent commands.
        response: Delay and lag; None if they were not measured.
    """

    kind: Literal["vehicle"] = "vehicle"
    wheelbase_m: Annotated[float, at_most(_LONGEST_WHEELBASE_M, "m", "cm or mm")] = Field(gt=0.0)
    gains: GainsSection
    limits: LimitsSection
    response: ResponseSection | None = None

    @model_validator(mode="after")
    def _possible(self) -> VehicleCalibration:
        # The driver's own classes check plausibility.
        _ = self.vehicle_gains, self.drive_limits
        return self

    @property
    def vehicle_gains(self) -> VehicleGains:
        """Gains in the driver's class."""
        return VehicleGains(**self.gains.model_dump())

    @property
    def drive_limits(self) -> DriveLimits:
        """Limits in the driver's class."""
        return DriveLimits(**self.limits.model_dump())


class TargetCalibration(Calibration):
    """A flat face on which an attack is shown.

    Attributes:
        subject: Name of the motion-capture subject it is fixed to.
        corners_in_subject_m: The face's corners in the subject's frame, for the texture's top left, top right, bottom right and
            bottom left, as seen from the front [m].
    """

    kind: Literal["target"] = "target"
    subject: str = Field(min_length=1, max_length=24)
    corners_in_subject_m: tuple[Point3, Point3, Point3, Point3]

    @field_validator("corners_in_subject_m")
    @classmethod
    def _a_face(cls, corners: tuple[Point3, ...]) -> tuple[Point3, ...]:
        points = np.array(corners)
        normal = np.cross(points[1] - points[0], points[3] - points[0])
        if np.ptp(points, axis=0).max() > _LARGEST_FACE_M:
            raise ValueError(f"expected a face of at most {_LARGEST_FACE_M:g} m; is it in cm or mm?")
        away_m = float(np.linalg.norm(points.mean(axis=0)))
        if away_m > _FURTHEST_FACE_M:
            raise ValueError(
                f"expected a face within {_FURTHEST_FACE_M:g} m of its subject's origin, got {away_m:.1f} m; is a length, such as the wand's tip, in cm or mm?"
            )
        area = float(np.linalg.norm(normal))
        if area < 1e-4:
            raise ValueError("expected four corners that span a face, got a line or a point")
        off = float(abs((points[2] - points[0]) @ normal) / area)
        if off > _PLANAR_TOLERANCE_M:
            raise ValueError(
                f"expected four corners in one plane, the third is {off * 1000:.1f} mm off: measure again"
            )
        sides = points - np.roll(points, 1, axis=0)
        diagonals = np.linalg.norm(points[2:] - points[:2], axis=1)
        size_m = float(diagonals.max())
        if np.abs(sides[:2] + sides[2:]).max() > _SKEW * size_m or np.ptp(diagonals) > _SKEW * size_m:
            raise ValueError(
                "expected the corners of a rectangle in the order top left, top right, bottom right, bottom left; got others, measure again"
            )
        return corners

    @property
    def corners(self) -> Array:
        """Corners ``[4, 3]`` [m]."""
        return np.array(self.corners_in_subject_m)


class RoomCalibration(Calibration):
    """The area and path of the car.

    Attributes:
        path: Reference path as `advnerf_core.driving.path.Path.to_dict` writes it.
        off_track_m: Magnitude of the cross-track error beyond which the car is off the track [m].
        fence_m: Corners of the polygon that the rear axle may not leave [m].
        start_pose: Start of the experiments: x [m], y [m], yaw [rad].
    """

    kind: Literal["room"] = "room"
    path: dict[str, Any]
    off_track_m: LengthM = Field(gt=0.0)
    fence_m: tuple[Point2, ...] = Field(min_length=3)
    start_pose: tuple[float, float, Angle]

    @field_validator("path")
    @classmethod
    def _a_path(cls, path: dict[str, Any]) -> dict[str, Any]:
        within_a_turn(DrivingPath.from_dict(path).start_pose[2])
        return path

    @field_validator("fence_m")
    @classmethod
    def _a_fence(cls, fence: tuple[Point2, ...]) -> tuple[Point2, ...]:
        require_simple(fence)
        return fence

    @model_validator(mode="after")
    def _inside_the_fence(self) -> RoomCalibration:
        path = self.reference_path
        if not inside(self.start_pose[:2], self.fence_m):
            raise ValueError(f"expected start_pose inside fence_m, got {self.start_pose} outside")
        points = path.pose_at(np.linspace(0.0, path.length_m, 200))[:, :2].tolist()
        if not any(inside((x, y), self.fence_m) for x, y in points):
            raise ValueError(
                "expected the path inside fence_m, but all of it is outside; are both in m, in the same frame?"
            )
        extent_m, room_m = (float(np.ptp(np.array(each), axis=0).max()) for each in (points, self.fence_m))
        if room_m > _MOST_ROOM * extent_m:
            raise ValueError(
                f"expected a fence_m of at most {_MOST_ROOM:g} times the path's extent of {extent_m:.2g} m, got {room_m:.4g} m; are both in m?"
            )
        return self

    @property
    def reference_path(self) -> DrivingPath:
        """The reference path."""
        return DrivingPath.from_dict(self.path)


C = TypeVar("C", bound=Calibration)


def load_calibration(model: type[C], path: Path | str) -> C:
    """Read a calibration file. All its errors are one `CalibrationError` that names the file, the lines and the keys."""
    try:
        return validate(model, read_yaml(Path(path)))
    except MissingFileError:
        raise CalibrationError(f"{path}: no such calibration file") from None
    except ConfigError as error:
        raise CalibrationError(str(error)) from None


def measured(model: type[C], **values: Any) -> C:
    """A calibration from measured values, of which those that are impossible are one `CalibrationError`."""
    try:
        return validate(model, Document(values, "what was measured"))
    except ConfigError as error:
        raise CalibrationError(str(error)) from None


def parse_calibration(model: type[C], content: bytes, source: str) -> C:
    """The same from the content of a file, such as one in a bag; ``source`` names it in messages."""
    try:
        return validate(model, parse_yaml(decode_text(content, source), source))
    except ConfigError as error:
        raise CalibrationError(str(error)) from None


def refuse_other_kinds(calibration: Calibration, path: Path) -> None:
    """Refuse to replace a file that is no calibration of the same kind, such as the measured room by a target.

    Raises:
        CalibrationError: The file is of another kind, or none of ours.
    """
    if not path.is_file() or path.stat().st_size == 0:
        return
    try:
        found = read_yaml(path).data
    except ConfigError:
        found = None
    kind = found.get("kind") if isinstance(found, dict) else None
    if kind != calibration.kind:
        raise CalibrationError(
            f"expected to write a calibration of the kind {calibration.kind} to a new file or over one of this kind, got {path}, "
            f"which is {'no calibration' if kind is None else f'of the kind {kind}'}; choose another --output"
        )


def save_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write a calibration file atomically.

    Raises:
        CalibrationError: The file cannot be written, or would replace a file of another kind.
    """
    path = Path(path)
    refuse_other_kinds(calibration, path)
    values = calibration.model_dump(mode="python")
    # Files without measurements stay as short as before.
    kept = {key: value for key, value in values.items() if key not in _OPTIONAL or value not in (None, {})}
    text = dump_yaml(kept, default_flow_style=None, width=120)
    try:
        write_atomically(path, text)
    except OSError as error:
        raise CalibrationError(f"cannot write {path}: {error.strerror or error}") from error
