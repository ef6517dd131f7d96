"""The phone that photographs the room: its poses and its colours."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, camera_mount, look_at, planar_pose, rotation_z
from hardware.worlds.lab.config import LabConfig, PhoneConfig, TrackConfig
from hardware.worlds.lab.furniture import Solid, furnish, vehicle_in_room

MAX_TRIES = 1000


def apply_colours(rgb: NDArray[np.uint8], phone: PhoneConfig) -> NDArray[np.uint8]:
    """Turn the driving camera's colours into the phone's: ``clip(M rgb) ** gamma`` per pixel, values in 0..1.

    Args:
        rgb: Image ``[H, W, 3]``.
        phone: Colour matrix ``M`` and gamma.
    """
    mixed = cv2.transform(
        rgb.astype(np.float32) / np.float32(255.0), np.asarray(phone.colour_matrix, np.float32)
    )
    toned = cv2.pow(np.clip(mixed, 0.0, 1.0), phone.gamma)
    return np.asarray(np.rint(toned * 255.0), dtype=np.uint8)


def track_length(track: TrackConfig) -> float:
    """Length of the closed line [m]."""
    return 4.0 * (track.side_m - 2.0 * track.corner_radius_m) + 2.0 * math.pi * track.corner_radius_m


def track_pose(track: TrackConfig, s_m: float) -> tuple[float, float, float]:
    """Point and heading (x [m], y [m], yaw [rad]) of the line at arc length ``s_m``; 0 is where the bottom straight starts."""
    straight, arc = track.side_m - 2.0 * track.corner_radius_m, 0.5 * math.pi * track.corner_radius_m
    side, along = divmod(s_m % track_length(track), straight + arc)
    angle = max(along - straight, 0.0) / track.corner_radius_m
    x = min(along, straight) - 0.5 * straight + track.corner_radius_m * math.sin(angle)
    y = -0.5 * track.side_m + track.corner_radius_m * (1.0 - math.cos(angle))
    turn = 0.5 * math.pi * side
    c, s = math.cos(turn), math.sin(turn)
    return c * x - s * y, s * x + c * y, math.remainder(angle + turn, 2.0 * math.pi)


def walk_around_poses(config: LabConfig, count: int, rng: np.random.Generator) -> list[Array]:
    """Hand-held photos on a walk round the room, evenly spread in bearing: half look in, half look out.

    Args:
        config: The lab; the phone stays clear of its furniture.

    Returns:
        ``T_world_from_camera`` ``[4, 4]`` each.
    """
    solids, half = furnish(config), 0.5 * config.room.side_m
    poses = []
    for index in range(count):
        inwards = index % 2 == 0
        for _ in range(MAX_TRIES):
            bearing = 2.0 * math.pi * (index + rng.random()) / max(count, 1)
            position = _held_position(bearing, half, inwards, config.phone, rng)
            if not any(_inside(position, solid, margin_m=0.2) for solid in solids):
                break
        else:
            raise ValueError(
                "expected free space to walk in, found none; is the room too small for its furniture?"
            )
        T = look_at(position, _subject(position, bearing, half, inwards, rng))
        T[:3, :3] = T[:3, :3] @ rotation_z(float(rng.normal(0.0, math.radians(2.0))))  # a hand is not level
        poses.append(T)
    return poses


def car_mounted_poses(config: LabConfig, count: int, rng: np.random.Generator) -> list[Array]:
    """Photos with the phone on the car, pushed round the track: on the line, beside it, and straight on at corners.

    The camera height varies over ``phone.mount_height_m``, the pitch is the driving camera's plus or minus 3 degrees.
    Places where the car's body would not fit are left out.

    Returns:
        ``T_world_from_camera`` ``[4, 4]`` each.
    """
    camera, phone = config.camera, config.phone
    probe = vehicle_in_room(config)
    length, poses = track_length(config.track), []
    for index in range(count):
        for _ in range(MAX_TRIES):
            pose = _driven_pose(config.track, length * (index + rng.random()) / max(count, 1), index, rng)
            if probe.fits(*pose):
                break
        else:
            raise ValueError(
                "expected free space beside the track, found none; is the track too close to the walls?"
            )
        height = rng.uniform(*phone.mount_height_m)
        pitch = camera.pitch_down_rad + rng.normal(0.0, math.radians(3.0))
        poses.append(planar_pose(*pose) @ camera_mount(camera.x_m, camera.y_m, height, pitch))
    return poses


def _held_position(
    bearing: float, half_m: float, inwards: bool, phone: PhoneConfig, rng: np.random.Generator
) -> Array:
    # A ray from the middle comes within 0.5 m of the square's wall at this distance.
    reach = (half_m - 0.5) / max(abs(math.cos(bearing)), abs(math.sin(bearing)))
    # Looking in, step back to the wall; looking at the wall, step back to the middle.
    radius = rng.uniform(0.6 * reach, reach) if inwards else rng.uniform(0.8, 0.6 * reach)
    return np.array(
        [radius * math.cos(bearing), radius * math.sin(bearing), rng.uniform(*phone.walk_height_m)]
    )


def _subject(
    position: Array, bearing: float, half_m: float, inwards: bool, rng: np.random.Generator
) -> Array:
    if inwards:
        # Across the middle to the other side: the floor, the island and the far furniture.
        away = bearing + math.pi + rng.normal(0.0, 0.5)
        reach = rng.uniform(0.3, 0.9) * half_m
        return np.array([reach * math.cos(away), reach * math.sin(away), rng.uniform(0.0, 1.0)])
    outward = bearing + rng.normal(0.0, 0.8)
    reach = 2.0 * half_m
    return np.array(
        [
            position[0] + reach * math.cos(outward),
            position[1] + reach * math.sin(outward),
            rng.uniform(-1.6, 1.8),
        ]
    )


def _inside(point: Array, solid: Solid, margin_m: float) -> bool:
    c, s = math.cos(solid.yaw_rad), math.sin(solid.yaw_rad)
    dx, dy, dz = point - np.asarray(solid.centre_m)
    local = (c * dx + s * dy, c * dy - s * dx, dz)
    return all(abs(value) <= half + margin_m for value, half in zip(local, solid.half_m, strict=True))


def _driven_pose(
    track: TrackConfig, s_m: float, index: int, rng: np.random.Generator
) -> tuple[float, float, float]:
    x, y, yaw = track_pose(track, s_m)
    if index % 4 == 3:
        # Where a car ends up that misses a corner: beyond the end of the straight before this point.
        straight, arc = track.side_m - 2.0 * track.corner_radius_m, 0.5 * math.pi * track.corner_radius_m
        x, y, yaw = track_pose(track, s_m // (straight + arc) * (straight + arc) + straight)
        ahead, offset = rng.uniform(0.0, 1.6), rng.normal(0.0, 0.3)
        turn = rng.normal(0.25, 0.3)
    else:
        spread = 0.15 if index % 2 == 0 else 0.45
        ahead, offset, turn = 0.0, rng.normal(0.0, spread), rng.normal(0.0, 0.8 * spread)
    c, s = math.cos(yaw), math.sin(yaw)
    return float(x + ahead * c - offset * s), float(y + ahead * s + offset * c), float(yaw + turn)
