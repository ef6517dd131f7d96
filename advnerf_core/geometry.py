"""Poses, pinhole cameras and the vehicle state: the numpy-only leaf that every other package may import.

Conventions (all of advnerf): metres, radians, seconds. The world is the motion-capture frame, z up. The car frame sits on
the floor under the rear axle, x forward, y left. Cameras have OpenCV axes: x right, y down, z forward. A transform
``T_a_from_b`` is a ``[4, 4]`` float64 matrix that takes coordinates in frame ``b`` to frame ``a``. Pixel ``(column, row)``
covers ``[column, column + 1) x [row, row + 1)``, so its centre is at ``+0.5``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# OpenGL cameras (nerfstudio, Instant-NGP, blender files) look along -z with y up; ours look along +z with y down.
OPENGL_FROM_OPENCV: Array = np.diag([1.0, -1.0, -1.0, 1.0])
OPENGL_FROM_OPENCV.setflags(write=False)
# Half the side of an image over its focal length, at 170 degrees of view; also a fisheye's is far less.
_WIDEST_SLOPE = 11.43


@dataclass(frozen=True)
class VehicleState:
    """Pose of the rear axle in the world, with speed and steering.

    Attributes:
        x_m: Position of the rear axle along world x [m].
        y_m: Position of the rear axle along world y [m].
        yaw_rad: Heading, counter-clockwise from world x [rad].
        speed_mps: Signed speed along the heading [m/s].
        steering_rad: Front wheel angle, left positive [rad].
    """

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float = 0.0
    steering_rad: float = 0.0

    @property
    def T_world_from_car(self) -> Array:
        """Transform ``[4, 4]`` from the car frame to the world."""
        return planar_pose(self.x_m, self.y_m, self.yaw_rad)


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of an ideal pinhole camera, in pixels.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        fx: Horizontal focal length [px].
        fy: Vertical focal length [px].
        cx: Principal point, column, with pixel centres at +0.5 [px].
        cy: Principal point, row, with pixel centres at +0.5 [px].
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"expected a positive image size, got {self.width} x {self.height}")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(f"expected finite intrinsics with positive focal lengths, got {self}")

    @property
    def matrix(self) -> Array:
        """Camera matrix ``[3, 3]`` for pixel coordinates with centres at +0.5."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def cropped(self, left_px: int, top_px: int, width: int, height: int) -> Pinhole:
        """Intrinsics of a window of the image; the window may not leave the image."""
        inside = (
            left_px >= 0 and top_px >= 0 and left_px + width <= self.width and top_px + height <= self.height
        )
        if not inside:
            raise ValueError(
                f"expected a crop inside {self.width} x {self.height}, got {width} x {height} at ({left_px}, {top_px})"
            )
        return Pinhole(width, height, self.fx, self.fy, self.cx - left_px, self.cy - top_px)

    def resized(self, width: int, height: int) -> Pinhole:
        """Intrinsics after resampling the whole image to ``width x height``."""
        sx, sy = width / self.width, height / self.height
        return Pinhole(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def directions(self) -> Array:
        """Directions of all pixel centres in the camera frame with unit planar depth, ``[height, width, 3]``."""
        columns = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        rows = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        x, y = np.meshgrid(columns, rows)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def project(self, points_in_camera: ArrayLike) -> Array:
        """Project points ``[..., 3]`` in front of the camera to pixels ``[..., 2]``; behind it the result is meaningless."""
        p = np.asarray(points_in_camera, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = p[..., :2] / p[..., 2:3]
        return uv * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy])


def require_camera(pinhole: Pinhole) -> Pinhole:
    """Intrinsics from a user's file, if a camera can have them. Those of a crop need not pass: its centre may be outside.

    Raises:
        ValueError: They are normalised, or belong to an image of another size.
    """
    size, focal, centre = (pinhole.width, pinhole.height), (pinhole.fx, pinhole.fy), (pinhole.cx, pinhole.cy)
    wide = any(0.5 * side > _WIDEST_SLOPE * f for side, f in zip(size, focal, strict=True))
    if wide or (min(size) > 2 and min(centre) > 0.0 and max(centre) <= 1.0):
        cure = "if they are normalised, multiply fx and cx by the width, fy and cy by the height"
    elif not all(0.0 <= c < side for side, c in zip(size, centre, strict=True)):
        cure = "if they belong to a larger image, give its size as the image's"
    else:
        return pinhole
    raise ValueError(
        f"expected a focal length and a centre in pixels of an image of {size[0]} x {size[1]}, got fx {focal[0]:g}, fy {focal[1]:g}, "
        f"cx {centre[0]:g}, cy {centre[1]:g}; {cure}"
    )


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Wrap angles to ``[-pi, pi)`` [rad]."""
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def planar_pose(x_m: float, y_m: float, yaw_rad: float) -> Array:
    """Transform ``[4, 4]`` of a frame on the floor."""
    return make_transform(rotation_z(yaw_rad), np.array([x_m, y_m, 0.0]))


def planar_poses(states: ArrayLike) -> Array:
    """Transforms ``[..., 4, 4]`` of car states ``[..., >= 3]`` whose first three entries are x [m], y [m], yaw [rad]."""
    s = np.asarray(states, dtype=np.float64)
    c, n = np.cos(s[..., 2]), np.sin(s[..., 2])
    T = np.zeros((*s.shape[:-1], 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = c, -n, n, c
    T[..., 0, 3], T[..., 1, 3] = s[..., 0], s[..., 1]
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    return T


def make_transform(rotation: ArrayLike, translation_m: ArrayLike) -> Array:
    """Transform ``[4, 4]`` from a rotation ``[3, 3]`` and a translation ``[3]`` [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


def invert_transform(T: ArrayLike) -> Array:
    """Inverse of rigid transforms ``[..., 4, 4]``."""
    T = np.asarray(T, dtype=np.float64)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3:4])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform_points(T_a_from_b: ArrayLike, points_in_b: ArrayLike) -> Array:
    """Apply one transform ``[4, 4]`` to points ``[..., 3]``."""
    T = np.asarray(T_a_from_b, dtype=np.float64)
    return np.asarray(points_in_b, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def rotation_x(angle_rad: float) -> Array:
    """Rotation ``[3, 3]`` about x."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Array:
    """Rotation ``[3, 3]`` about y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Array:
    """Rotation ``[3, 3]`` about z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def camera_mount(
    x_m: float, y_m: float, z_m: float, pitch_down_rad: float = 0.0, yaw_rad: float = 0.0
) -> Array:
    """Transform ``T_parent_from_camera [4, 4]`` of a camera on a parent with x forward, y left, z up.

    Args:
        x_m: Camera position in the parent frame [m].
        y_m: Camera position in the parent frame [m].
        z_m: Camera position in the parent frame [m].
        pitch_down_rad: Angle of the optical axis below the horizontal plane [rad].
        yaw_rad: Angle of the optical axis to the left of parent x [rad].
    """
    forward_left_up_from_opencv = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    R = rotation_z(yaw_rad) @ rotation_y(pitch_down_rad) @ forward_left_up_from_opencv
    return make_transform(R, np.array([x_m, y_m, z_m]))


def look_at(position_m: ArrayLike, target_m: ArrayLike) -> Array:
    """Transform ``T_world_from_camera`` of an upright camera at ``position_m`` that looks at ``target_m`` (both ``[3]``)."""
    position, target = np.asarray(position_m, dtype=np.float64), np.asarray(target_m, dtype=np.float64)
    z = target - position
    if np.hypot(z[0], z[1]) < 1e-9:
        raise ValueError(
            f"expected a target that is not straight above or below the camera, got {position} -> {target}"
        )
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return make_transform(np.stack([x, np.cross(z, x), z], axis=1), position)


def quaternion_from_rotation(R: ArrayLike) -> Array:
    """Unit quaternion ``[4]`` in order x, y, z, w with ``w >= 0`` of a rotation ``[3, 3]`` (Shepperd's method)."""
    m = np.asarray(R, dtype=np.float64)
    trace = np.trace(m)
    # The largest of the four squared components is at least 1/4, so dividing by it is always well conditioned.
    squared = np.array([1 + 2 * m[0, 0] - trace, 1 + 2 * m[1, 1] - trace, 1 + 2 * m[2, 2] - trace, 1 + trace])
    largest = int(np.argmax(squared))
    if largest == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squared[3]])
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = np.empty(4)
        q[i], q[j], q[k] = squared[i], m[j, i] + m[i, j], m[k, i] + m[i, k]
        q[3] = m[k, j] - m[j, k]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def rotation_from_quaternion(quaternion_xyzw: ArrayLike) -> Array:
    """Rotation ``[3, 3]`` of a quaternion ``[4]`` in order x, y, z, w; it is normalised first."""
    q = np.asarray(quaternion_xyzw, dtype=np.float64)
    norm = np.linalg.norm(q)
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"expected a quaternion of unit length, got {q.tolist()}")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def yaw_of(T_world_from_car: ArrayLike) -> float:
    """Heading of a frame's x axis in the world's xy plane [rad]."""
    T = np.asarray(T_world_from_car, dtype=np.float64)
    return float(np.arctan2(T[1, 0], T[0, 0]))


def interpolate_transform(T_start: ArrayLike, T_end: ArrayLike, fraction: float) -> Array:
    """Pose between two poses ``[4, 4]``: translation linear, rotation by slerp; ``fraction`` outside 0..1 extrapolates."""
    a, b = np.asarray(T_start, dtype=np.float64), np.asarray(T_end, dtype=np.float64)
    qa, qb = quaternion_from_rotation(a[:3, :3]), quaternion_from_rotation(b[:3, :3])
    cosine = float(qa @ qb)
    if cosine < 0.0:
        qb, cosine = -qb, -cosine
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        q = qa + fraction * (qb - qa)
    else:
        q = (np.sin((1.0 - fraction) * angle) * qa + np.sin(fraction * angle) * qb) / np.sin(angle)
    return make_transform(rotation_from_quaternion(q), a[:3, 3] + fraction * (b[:3, 3] - a[:3, 3]))


@dataclass(frozen=True)
class Rectangle:
    """An oriented rectangle on the ground.

    Attributes:
        x_m: Centre [m].
        y_m: Centre [m].
        half_length_m: Half of the extent along its own x axis [m].
        half_width_m: Half of the extent along its own y axis [m].
        yaw_rad: Heading of its x axis [rad].
    """

    x_m: float
    y_m: float
    half_length_m: float
    half_width_m: float
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (self.half_length_m > 0.0 and self.half_width_m > 0.0):
            raise ValueError(f"expected a rectangle with half extents above 0 m, got {self}")
