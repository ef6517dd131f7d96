"""Checks the pictures, depth and poses that a simulator in another process returns.

Each function raises a named error of `hardware.worlds.remote_errors` that says what was expected and what came.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole, VehicleState, transform_points, wrap_angle
from hardware.worlds.remote_errors import WrongDepthError, WrongPictureError, WrongPoseError
from hardware.worlds.world import Depth, Rgb

_POSE_TOLERANCE = 1e-3  # of requested poses [m, and entries of rotations]
_PUT_TOLERANCE = 1e-4  # of the car after a reset [m, rad and m/s]
# More than a car can move between two commands: beyond its speed [m, and as a factor], and turning [rad/s].
_JUMP_M, _JUMP_FACTOR, _JUMP_RADPS, _SHORTEST_S = 0.5, 1.6, 6.0, 0.1
# Largest share of a camera's points that may seem to lie under the lowest ground, by more than this and this share of their distance.
_BELOW_SHARE, _BELOW_M, _BELOW_RANGE, _EVERY_PX = 0.1, 0.3, 0.03, 4
# The lower edge of the driving camera's picture shows the ground, not something at this share of the camera's height.
_EDGE_ROWS, _EDGE_HEIGHT = 0.06, 0.4
_LEAST_FINITE, _RANGE_TOLERANCE = 0.02, 0.01


def state_in(result: Mapping[str, Any]) -> tuple[VehicleState, bool]:
    """State of the car and whether it is blocked, from an answer.

    Raises:
        WrongPoseError: The state is missing or not finite.
    """
    listed, blocked = result.get("state"), result.get("blocked")
    numbers = [value for value in listed if type(value) in (int, float)] if isinstance(listed, list) else []
    if len(numbers) != 5 or not all(map(math.isfinite, numbers)) or not isinstance(blocked, bool):
        raise WrongPoseError(
            f"expected x, y, yaw, speed and wheel angle as finite numbers, and whether the car is blocked; got {result!r:.160}"
        )
    return VehicleState(*map(float, numbers)), blocked


def require_put_down(state: VehicleState, x_m: float, y_m: float, yaw_rad: float) -> None:
    """Check that the car is at rest at the requested pose.

    Raises:
        WrongPoseError: The car is at another pose, or moves.
    """
    apart = math.dist((state.x_m, state.y_m), (x_m, y_m))
    turned = abs(float(wrap_angle(state.yaw_rad - yaw_rad)))
    if not max(apart, turned, abs(state.speed_mps)) < _PUT_TOLERANCE:
        raise WrongPoseError(
            f"expected the car at rest at ({x_m:.3f} m, {y_m:.3f} m, {yaw_rad:.4f} rad) after reset; got {state}"
        )


def require_driven(before: VehicleState, after: VehicleState, speed_mps: float, duration_s: float) -> None:
    """Check that the car has not moved or turned farther than a car can.

    Raises:
        WrongPoseError: The car has moved or turned too far.
    """
    fastest_mps = max(abs(before.speed_mps), abs(speed_mps))
    way_m = math.dist((after.x_m, after.y_m), (before.x_m, before.y_m))
    turned = abs(float(wrap_angle(after.yaw_rad - before.yaw_rad)))
    most_m = _JUMP_M + _JUMP_FACTOR * fastest_mps * duration_s
    if way_m > most_m or turned > _JUMP_RADPS * max(duration_s, _SHORTEST_S):
        raise WrongPoseError(
            f"expected a car at {fastest_mps:g} m/s to move at most {most_m:.2f} m in {duration_s:g} s; got {way_m:.2f} m and a turn of {turned:.2f} rad"
        )


def picture_in(arrays: Mapping[str, NDArray[Any]], pinhole: Pinhole, T_world_from_camera: Array) -> Rgb:
    """The picture ``[H, W, 3]`` of an answer, taken from the requested pose.

    Raises:
        WrongPictureError: The picture is missing, of another size or type, or of one value.
        WrongPoseError: The picture was taken from another pose.
    """
    rgb, taken = arrays.get("rgb"), arrays.get("T_world_from_camera")
    size = (pinhole.height, pinhole.width, 3)
    if rgb is None or rgb.shape != size or rgb.dtype != np.uint8:
        raise WrongPictureError(f"expected a picture {list(size)} uint8; got {_form(rgb)}")
    if rgb.min() == rgb.max():
        raise WrongPictureError(
            f"expected something to be seen; got a picture of the one value {rgb.flat[0]}"
        )
    if taken is None or taken.shape != (4, 4):
        raise WrongPoseError(f"expected the pose that the picture was taken from [4, 4]; got {_form(taken)}")
    apart = float(np.abs(taken - T_world_from_camera).max())
    if not apart < _POSE_TOLERANCE:
        raise WrongPoseError(
            f"expected a picture from {T_world_from_camera[:3, 3].round(3).tolist()} m; got one from {taken[:3, 3].round(3).tolist()} m, or one that is turned"
        )
    return rgb


def depth_in(
    arrays: Mapping[str, NDArray[Any]],
    pinhole: Pinhole,
    T_world_from_camera: Array,
    range_m: tuple[float, float],
    lowest_m: float,
) -> Depth:
    """Planar depth ``[H, W]`` [m] of an answer: within the camera's range or infinite, and not under the ground.

    Args:
        T_world_from_camera: Pose ``[4, 4]`` of the camera.
        range_m: Nearest and farthest depth [m].
        lowest_m: Height of the lowest ground [m].

    Raises:
        WrongDepthError: The array is not such a depth map.
    """
    depth_m, size = arrays.get("depth"), (pinhole.height, pinhole.width)
    if depth_m is None or depth_m.shape != size or depth_m.dtype != np.float32:
        raise WrongDepthError(f"expected depth {list(size)} float32; got {_form(depth_m)}")
    near_m, far_m = range_m[0] * (1.0 - _RANGE_TOLERANCE), range_m[1] * (1.0 + _RANGE_TOLERANCE)
    fits = ((depth_m >= near_m) & (depth_m <= far_m)) | (depth_m == np.inf)
    if not fits.all() or np.isfinite(depth_m).mean() < _LEAST_FINITE:
        known = depth_m[np.isfinite(depth_m)]
        span = f"{known.min():.3g} to {known.max():.3g} m" if known.size else "nothing finite"
        raise WrongDepthError(
            f"expected planar depth from {range_m[0]:g} to {range_m[1]:g} m, or infinite; got {span}, and {int(np.isnan(depth_m).sum())} NaN"
        )
    every = slice(None, None, _EVERY_PX)
    z_m = depth_m[every, every]
    seen = np.isfinite(z_m)
    height_m = transform_points(
        T_world_from_camera, pinhole.directions()[every, every][seen] * z_m[seen][:, None]
    )[:, 2]
    below = float(np.mean(height_m < lowest_m - _BELOW_M - _BELOW_RANGE * z_m[seen]))
    if below > _BELOW_SHARE:
        raise WrongDepthError(
            f"expected planar depth in metres; got one that puts {100 * below:.0f} % of what is seen under the ground"
        )
    return depth_m


def require_ground_ahead(depth_m: Depth, pinhole: Pinhole, T_world_from_camera: Array) -> None:
    """Check that the lower edge of the driving camera's picture shows ground; not checked where part of it is at infinite depth.

    Raises:
        WrongDepthError: An object is in the air right before the camera.
    """
    rows = slice(pinhole.height - max(int(_EDGE_ROWS * pinhole.height), 1), None)
    z_m = depth_m[rows]
    if not np.isfinite(z_m).all():
        return
    points = (pinhole.directions()[rows] * z_m[..., None]).reshape(-1, 3)
    height_m = float(np.median(transform_points(T_world_from_camera, points)[:, 2]))
    if height_m > _EDGE_HEIGHT * float(T_world_from_camera[2, 3]):
        raise WrongDepthError(
            f"expected the ground at the lower edge of the picture; got something {height_m:.2f} m above it"
        )


def _form(array: NDArray[Any] | None) -> str:
    return "none" if array is None else f"{array.dtype} {list(array.shape)}"
