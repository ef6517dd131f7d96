"""Conversion between CARLA's left-handed world and our right-handed one.

CARLA (Unreal Engine) has x forward, y to the *right*, z up, rotations in degrees: yaw turns x towards y (clockwise seen from above),
pitch raises the nose, roll lowers the right side. They apply in the order roll, pitch, yaw about fixed axes. Ours is right-handed:
y to the left, angles counter-clockwise. One mirror ``M = diag(1, -1, 1)`` goes between them: a point becomes ``M p``, a rotation
``M R M``. Hence for the same body, in our axes, ``R = Rz(-yaw) Ry(-pitch) Rx(roll)``.

A CARLA camera looks along its own x; ours (OpenCV) along z with y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import (
    Array,
    camera_mount,
    invert_transform,
    make_transform,
    planar_pose,
    rotation_x,
    rotation_y,
    rotation_z,
    transform_points,
)

# Axes forward, left, up of a camera's body from its OpenCV axes.
BODY_FROM_CAMERA: Array = camera_mount(0.0, 0.0, 0.0)
BODY_FROM_CAMERA.setflags(write=False)
_GIMBAL = 1e-9  # below this cosine of the pitch, yaw and roll turn about the same axis


@dataclass(frozen=True)
class CarlaPose:
    """A ``carla.Transform`` as plain numbers, in CARLA's axes.

    Attributes:
        x_m: Location [m].
        y_m: Location [m], to the right of x.
        z_m: Location [m], up.
        pitch_deg: Nose up [deg].
        yaw_deg: Clockwise seen from above [deg].
        roll_deg: Right side down [deg].
    """

    x_m: float
    y_m: float
    z_m: float
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    roll_deg: float = 0.0

    @classmethod
    def of(cls, transform: Any) -> CarlaPose:
        """Read a ``carla.Transform``."""
        at, turned = transform.location, transform.rotation
        return cls(at.x, at.y, at.z, turned.pitch, turned.yaw, turned.roll)

    @classmethod
    def from_matrix(cls, T_mirrored_from_body: ArrayLike) -> CarlaPose:
        """The pose of a body whose right-handed transform ``[4, 4]`` is given (CARLA's world with y mirrored).

        Looking straight up or down, where yaw and roll are one turn, all of it counts as yaw.
        """
        T = np.asarray(T_mirrored_from_body, dtype=np.float64)
        R = T[:3, :3]
        level = math.hypot(R[0, 0], R[1, 0])
        pitch = math.atan2(R[2, 0], level)
        if level > _GIMBAL:
            yaw, roll = -math.atan2(R[1, 0], R[0, 0]), math.atan2(R[2, 1], R[2, 2])
        else:
            yaw, roll = -math.atan2(-R[0, 1], R[1, 1]), 0.0
        x, y, z = (float(value) for value in T[:3, 3])
        return cls(x, -y, z, math.degrees(pitch), math.degrees(yaw), math.degrees(roll))

    @property
    def matrix(self) -> Array:
        """Right-handed transform ``[4, 4]`` of the body, in CARLA's world with y mirrored."""
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        return make_transform(
            rotation_z(-yaw) @ rotation_y(-pitch) @ rotation_x(roll), [self.x_m, -self.y_m, self.z_m]
        )

    def to_transform(self, library: Any) -> Any:
        """The pose as a ``carla.Transform`` of the given library (single precision)."""
        return library.Transform(
            library.Location(x=self.x_m, y=self.y_m, z=self.z_m),
            library.Rotation(pitch=self.pitch_deg, yaw=self.yaw_deg, roll=self.roll_deg),
        )

    def distance_to(self, other: CarlaPose) -> tuple[float, float]:
        """Distance [m] and rotation angle [rad] to another pose."""
        apart = invert_transform(self.matrix) @ other.matrix
        # The angle from the sine of its half: exact for small turns, unlike the arc cosine of the trace.
        sine = np.linalg.norm(apart[:3, :3] - np.eye(3)) / math.sqrt(8.0)
        return float(np.linalg.norm(apart[:3, 3])), 2.0 * math.asin(min(float(sine), 1.0))


class SceneFrame:
    """Our world in CARLA's: a flat frame with its origin at a junction, z up, x along a road.

    Args:
        x_m: Origin in CARLA's world, y mirrored [m].
        y_m: Origin in CARLA's world, y mirrored [m].
        z_m: Height of our ground in CARLA's world [m].
        yaw_rad: Our x axis in CARLA's world, y mirrored: counter-clockwise [rad].

    Attributes:
        T_mirrored_from_world: From our world to CARLA's with y mirrored ``[4, 4]``.
    """

    def __init__(self, x_m: float, y_m: float, z_m: float, yaw_rad: float) -> None:
        self.yaw_rad = float(yaw_rad)
        self.T_mirrored_from_world: Array = planar_pose(x_m, y_m, yaw_rad)
        self.T_mirrored_from_world[2, 3] = z_m

    def body_pose(self, T_world_from_body: ArrayLike) -> CarlaPose:
        """CARLA pose of an actor whose pose ``[4, 4]`` in our world is given (its axes: forward, left, up)."""
        return CarlaPose.from_matrix(
            self.T_mirrored_from_world @ np.asarray(T_world_from_body, dtype=np.float64)
        )

    def camera_pose(self, T_world_from_camera: ArrayLike) -> CarlaPose:
        """CARLA pose of a camera whose pose ``[4, 4]`` in our world is given (OpenCV axes)."""
        return self.body_pose(np.asarray(T_world_from_camera, dtype=np.float64) @ BODY_FROM_CAMERA.T)

    def world_from_body(self, pose: CarlaPose) -> Array:
        """Pose ``[4, 4]`` in our world of an actor in CARLA's."""
        return invert_transform(self.T_mirrored_from_world) @ pose.matrix

    def carla_point(self, point_in_world: ArrayLike) -> tuple[float, float, float]:
        """A point ``[3]`` of our world in CARLA's axes [m]."""
        x, y, z = transform_points(self.T_mirrored_from_world, point_in_world)
        return float(x), -float(y), float(z)
