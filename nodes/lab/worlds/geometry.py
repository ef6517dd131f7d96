"""Checks of a world's camera pose: depth of one view predicts depth of another, the ground is at z = 0, photographs and the box cover the paths.

Points are taken from depth to the world by the declared intrinsics, mount and pose of the car, and from there into another view. If that fails, the
same is tried with common mistakes (depth along the ray, millimetres, a mirrored picture, ...), so that the report can name the mistake.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import (
    OPENGL_FROM_OPENCV,
    Array,
    Pinhole,
    camera_mount,
    invert_transform,
    planar_pose,
    transform_points,
)
from hardware.worlds.paths import Pose
from hardware.worlds.world import Depth, require_depth
from nodes.lab.worlds.bench import WorldBench
from nodes.runtime.findings import MetButLook, NotMet

# Predicted depth may be off by this share, and colour by this much [grey levels, and of the picture's spread]; points on edges and behind others are.
_SAME_DEPTH, _LEAST_AGREEMENT, _BETTER_BY = 0.02, 0.75, 0.1
# Of the upper part only depth counts, of what the other view does not hide: it is far away, where colours are fine and objects cover each other.
_LEAST_UPPER = 0.85
# Fewer points of the lower part with the same depth are met, but shown: fine textures have other colours from another pose, but no other depth.
_DEPTH_TO_LOOK_AT = 0.97
# A largest depth that so many pixels have to the bit, before the car moves ahead and after, is no surface.
_SATURATED_SHARE = 0.01
_ROWS_OF_GROUND = 2
_SAME_COLOUR, _SAME_COLOUR_SHARE = 4.0, 0.2
_EVERY_PX = 3
# The second view of a pair: ahead by this many seconds of driving, aside by a share of half a lane, turned [rad].
_PAIRS = ((0.25, 0.0, 0.0), (0.1, 0.3, 0.35), (0.1, -0.3, -0.35))
# Ground under the lane ahead: height [m] as a share of the camera's, and of the distance.
_GROUND_SHARE, _HEIGHT_SHARE, _RANGE_SHARE, _LEAST_GROUND = 0.7, 0.03, 0.01, 200
_PHOTOS, _SEEN_BY, _SEEN_SHARE, _LEAST_LANE_PX = 60, 3, 0.9, 3.0
_INSIDE_SHARE = 0.99


@dataclass(frozen=True)
class Reading:
    """One interpretation of a world's depth and camera.

    Attributes:
        advice: The mistake if the world fits this reading, and what to change; empty for the contract's own.
        mount: Pose of the camera on the car ``[4, 4]``.
        planar: Converts the world's depth to planar depth ``[H, W]`` [m], with the directions ``[H, W, 3]`` of its pixels.
        seen: Converts the world's pictures to upright ones.
        pose: Converts the requested pose to the pose of the picture.
    """

    advice: str
    mount: Array
    planar: Callable[[Depth, Array], Depth] = lambda depth, directions: depth
    seen: Callable[[NDArray[np.float32]], NDArray[np.float32]] = lambda image: image
    pose: Callable[[Pose], Pose] = lambda pose: pose


@dataclass(frozen=True, eq=False)
class CameraView:
    """Output of the driving camera at a pose of the car: depth ``[H, W]``, and colours ``[H, W, 3]`` a little blurred [grey levels]."""

    pose: Pose
    depth: Depth
    rgb: NDArray[np.float32]


def views_agree(bench: WorldBench) -> str:
    """Points from depth at one pose of the car have the same place and colour from another pose."""
    pairs = _pairs_of_views(bench)
    for one, ahead in pairs[0]:
        _require_unsaturated(one.depth, ahead.depth)
    readings = _readings(bench)
    shares = [_agreement(reading, pairs, bench.world.camera_pinhole) for reading in readings]
    best = int(np.argmax(shares))
    if best and shares[best] > max(shares[0] + _BETTER_BY, 0.5 * _LEAST_AGREEMENT):
        raise NotMet(
            f"expected points seen from two poses to be in one place; {100 * shares[0]:.0f} % are as declared, {100 * shares[best]:.0f} % if "
            f"{readings[best].advice}"
        )
    if shares[0] < _LEAST_AGREEMENT:
        raise NotMet(
            f"expected points seen from two poses to be in one place; {100 * shares[0]:.0f} % are (at least {100 * _LEAST_AGREEMENT:.0f} % will do): "
            "compare T_car_from_camera and camera_pinhole with the camera that draws, and the pose with the one asked for"
        )
    found = f"{100 * shares[0]:.0f} % of the points seen from two poses are in one place, within {100 * _SAME_DEPTH:.0f} % of their distance and of one colour"
    _require_depth_alone(readings[0], pairs, bench.world.camera_pinhole, found)
    return found


def ground_is_flat(bench: WorldBench) -> str:
    """The lane ahead is at z = 0: the camera is as high as declared, and no object stands in a lane."""
    middles = np.array(
        [
            path.pose_at(float(s))[:2]
            for path in bench.description.paths.values()
            for s in np.arange(
                0.0,
                bench.driven_m(path) + bench.description.car.speed_mps,
                0.2 * bench.description.off_track_m,
            )
        ]
    )
    height_m, found, seen = float(bench.world.T_car_from_camera[2, 3]), [], 0
    for place in bench.places:
        points, depth = _points(bench, place)
        near = depth < 12.0 * max(height_m, 1e-3)
        points, depth = points[near], depth[near]
        apart = (
            np.linalg.norm(points[:, None, :2] - middles[None], axis=2).min(axis=1)
            if len(points)
            else np.zeros(0)
        )
        on_lane = apart < 0.5 * bench.description.off_track_m
        seen += int(on_lane.sum())
        found.append((points[on_lane, 2], depth[on_lane]))
    if seen < _LEAST_GROUND:
        raise NotMet(
            f"expected the driving camera to see the lane ahead; {seen} points of all views lie in a lane: is the camera above the ground, does it look "
            "ahead, and are the paths where the lanes are?"
        )
    z_m, depth_m = (np.concatenate(each) for each in zip(*found, strict=True))
    share = float(np.mean(np.abs(z_m) < _HEIGHT_SHARE * height_m + _RANGE_SHARE * depth_m))
    if share < _GROUND_SHARE:
        raise NotMet(
            f"expected the ground in the lanes at z = 0; got a median of {float(np.median(z_m)):+.3f} m, and {100 * share:.0f} % of it where it belongs: "
            f"compare the camera's height ({height_m:.3f} m) and pitch in T_car_from_camera with the camera that draws, and put the world's ground at z = 0"
        )
    return f"{100 * share:.0f} % of the lane ahead is at z = 0, its median at {float(np.median(z_m)):+.3f} m"


def box_holds_what_is_seen(bench: WorldBench) -> str:
    """The box holds everything that the driving camera sees, or at least the driven paths if the rest is contracted."""
    box = bench.description.box
    if box.contraction:
        points = _on_the_paths(bench, 50)
        what = "the paths"
    else:
        points = np.concatenate([_points(bench, place)[0] for place in bench.places])
        what = "the points that the driving camera sees"
    margin_m = 0.01 * np.subtract(box.max_m, box.min_m)
    share = float(np.mean(np.all((points > box.min_m - margin_m) & (points < box.max_m + margin_m), axis=1)))
    if share < _INSIDE_SHARE:
        raise NotMet(
            f"expected box to hold {what}; {100 * share:.1f} % are inside {box.min_m} .. {box.max_m} m: make it larger"
            + ("" if box.contraction else ", or set contraction=True where there is more to see outside")
        )
    return f"{100 * share:.1f} % of {what} are inside"


def photographs_cover(bench: WorldBench) -> str:
    """Photographs for learning are upright, above the ground, and see the driven stretch of each path."""
    world, count = bench.world, _PHOTOS
    poses = np.asarray(world.photo_poses(count, np.random.default_rng(0)), dtype=np.float64)
    if poses.shape != (count, 4, 4) or not np.isfinite(poses).all():
        raise NotMet(
            f"expected photo_poses({count}, rng) to give {count} finite transforms [4, 4]; got an array of shape {list(poses.shape)}"
        )
    R = poses[:, :3, :3]
    if np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() > 1e-6 or (np.linalg.det(R) < 0.0).any():
        raise NotMet("expected photo poses to be rigid transforms; got scaled, sheared or mirrored ones")
    upright, high = -R[:, 2, 1] > 0.0, poses[:, 2, 3] > 0.0
    if not (upright.all() and high.all()):
        raise NotMet(
            f"expected cameras above the ground with y pointing down; got {int((~high).sum())} of {count} below the ground and {int((~upright).sum())} upside "
            "down: OpenGL cameras, which look along -z with y up, must be turned: T @ diag(1, -1, -1, 1)"
        )
    points, lens = _on_the_paths(bench, 40), world.photo_pinhole
    seen = np.zeros(len(points), dtype=int)
    for T in poses:
        there = transform_points(invert_transform(T), points)
        pixels = lens.project(there)
        inside = (pixels >= 0.0).all(axis=1) & (pixels < [lens.width, lens.height]).all(axis=1)
        # Half a lane of a few pixels shows nothing of it.
        near = there[:, 2] < lens.fx * bench.description.off_track_m / _LEAST_LANE_PX
        seen += inside & (there[:, 2] > 0.0) & near
    share = float(np.mean(seen >= _SEEN_BY))
    if share < _SEEN_SHARE:
        raise NotMet(
            f"expected at least {_SEEN_BY} of {count} photographs to look at every stretch of the paths; {100 * share:.0f} % of the paths are seen so often: "
            f"take photographs along all paths, looking where the car looks, from where half a lane has {_LEAST_LANE_PX:g} pixels or more; poses are in metres"
        )
    return f"{100 * share:.0f} % of the paths are looked at by {_SEEN_BY} of {count} photographs or more"


def _on_the_paths(bench: WorldBench, count: int) -> Array:
    """Points on the ground along the driven stretch of each path ``[P * count, 3]`` [m]."""
    return np.array(
        [
            [*path.pose_at(float(s))[:2], 0.0]
            for path in bench.description.paths.values()
            for s in np.linspace(0.0, bench.driven_m(path), count)
        ]
    )


def _pairs_of_views(bench: WorldBench) -> list[list[tuple[CameraView, CameraView]]]:
    """Views from two poses near each other; one list for each kind of move."""
    car, half_lane_m = bench.description.car, bench.description.off_track_m
    first = [_view(bench, place) for place in bench.places]
    return [
        [
            (one, _view(bench, bench.beside(one.pose, ahead_s * car.speed_mps, left * half_lane_m, turn_rad)))
            for one in first
        ]
        for ahead_s, left, turn_rad in _PAIRS
    ]


def _view(bench: WorldBench, pose: Pose) -> CameraView:
    rgb, depth = require_depth(bench.world.observe_at(*pose))
    return CameraView(pose, depth, np.asarray(cv2.blur(rgb, (3, 3)), dtype=np.float32))


def _readings(bench: WorldBench) -> list[Reading]:
    """The contract's reading first, then common mistakes."""
    T = np.asarray(bench.world.T_car_from_camera, dtype=np.float64)
    level = camera_mount(*map(float, T[:3, 3]))
    return [
        Reading("", T),
        Reading(
            "depth is the distance along the ray; divide it by the length of the pixel's direction",
            T,
            lambda d, r: d / np.linalg.norm(r, axis=-1),
        ),
        Reading("depth is in millimetres; divide it by 1000", T, lambda d, r: d / 1000.0),
        Reading("depth is in centimetres; divide it by 100", T, lambda d, r: d / 100.0),
        Reading(
            "pictures are mirrored left to right; the camera's x points right",
            T,
            seen=lambda image: image[:, ::-1],
        ),
        Reading("pictures are upside down; row 0 is the top", T, seen=lambda image: image[::-1]),
        Reading(
            "they are taken from the car's own pose; multiply it by T_car_from_camera",
            camera_mount(0.0, 0.0, 0.0),
        ),
        Reading("the camera that draws is level; turn it as T_car_from_camera says", level),
        Reading(
            "T_car_from_camera is the inverse of what is meant; it takes camera coordinates to the car",
            invert_transform(T),
        ),
        Reading(
            "T_car_from_camera has OpenGL axes; multiply it by diag(1, -1, -1, 1) from the right",
            T @ OPENGL_FROM_OPENCV,
        ),
        Reading(
            "yaw turns to the right; it is counter-clockwise seen from above",
            T,
            pose=lambda p: (p[0], p[1], -p[2]),
        ),
        Reading(
            "yaw is taken for degrees; it is in radians",
            T,
            pose=lambda p: (p[0], p[1], float(np.radians(p[2]))),
        ),
    ]


def _agreement(reading: Reading, pairs: list[list[tuple[CameraView, CameraView]]], pinhole: Pinhole) -> float:
    """Share of points with the same place from both poses, for the kind of move with the lowest share."""
    shares = []
    for kind in pairs:
        found = np.array([_in_one_place(reading, one, other, pinhole) for one, other in kind])
        same, total = found.sum(axis=0)
        shares.append(same / max(total, 1))
    return float(min(shares))


def _in_one_place(reading: Reading, one: CameraView, other: CameraView, pinhole: Pinhole) -> tuple[int, int]:
    """Number of points of a view's lower part whose depth and colour agree with the other view, and number of points within the other view."""
    # The ground and objects on it.
    nearness, same_colour = _seen_again(reading, one, other, pinhole, slice(pinhole.height // 2, None))
    return int(np.sum((np.abs(nearness - 1.0) < _SAME_DEPTH) & same_colour)), len(nearness)


def _require_depth_alone(
    reading: Reading, pairs: list[list[tuple[CameraView, CameraView]]], pinhole: Pinhole, found: str
) -> None:
    """Raise where depth alone disagrees: in the upper half, or by less than what colours hide in the lower one."""
    above, below = slice(None, pinhole.height // 2), slice(pinhole.height // 2, None)
    upper = _depth_agreement(reading, pairs, pinhole, above, may_hide=True)
    if upper < _LEAST_UPPER:
        raise NotMet(
            f"expected points in the upper half of the picture, seen from two poses, to be in one place; {100 * upper:.0f} % are (at least "
            f"{100 * _LEAST_UPPER:.0f} % will do): give depth in every row, and infinity where nothing is measured; "
            "compare camera_pinhole with the camera that draws"
        )
    same = _depth_agreement(reading, pairs, pinhole, below, may_hide=False)
    if same < _DEPTH_TO_LOOK_AT:
        raise MetButLook(
            f"{found}; {100 * same:.1f} % are at one distance, where {100 * _DEPTH_TO_LOOK_AT:.0f} % are usual: look at T_car_from_camera and camera_pinhole "
            "beside the camera that draws"
        )


def _depth_agreement(
    reading: Reading,
    pairs: list[list[tuple[CameraView, CameraView]]],
    pinhole: Pinhole,
    rows: slice,
    may_hide: bool,
) -> float:
    """Share of points of some rows with the same depth from both poses, for the kind of move with the lowest share; 1 if nothing is seen there.

    Args:
        may_hide: Whether points behind what the other view has there do not count.
    """
    shares = [1.0]
    for kind in pairs:
        found = np.concatenate([_seen_again(reading, one, other, pinhole, rows)[0] for one, other in kind])
        counted = found[found < 1.0 + _SAME_DEPTH] if may_hide else found
        if len(found):
            same = np.abs(counted - 1.0) < _SAME_DEPTH
            shares.append(float(np.sum(same)) / max(len(counted), 1))
    return min(shares)


def _seen_again(
    reading: Reading, one: CameraView, other: CameraView, pinhole: Pinhole, rows: slice
) -> tuple[Array, NDArray[np.bool_]]:
    """Points of some rows of a view that are within the other view: depth there relative to what the other view has, and whether colours agree."""
    directions = pinhole.directions()
    part = slice(rows.start, rows.stop, _EVERY_PX), slice(None, None, _EVERY_PX)
    z_m = np.asarray(reading.seen(reading.planar(one.depth, directions)), dtype=np.float64)[part]
    known = np.isfinite(z_m) & (z_m > 0.0)
    colour = reading.seen(one.rgb)[part][known]
    T_other_from_one = (
        invert_transform(planar_pose(*reading.pose(other.pose)) @ reading.mount)
        @ planar_pose(*reading.pose(one.pose))
        @ reading.mount
    )
    there = transform_points(T_other_from_one, directions[part][known] * z_m[known][:, None])
    pixels = pinhole.project(there)
    inside = (there[:, 2] > 0.0) & (pixels > 1.0).all(axis=1)
    inside &= (pixels < [pinhole.width - 1.0, pinhole.height - 1.0]).all(axis=1)
    if not inside.any():
        return np.zeros(0), np.zeros(0, dtype=bool)
    # On a plane the inverse of depth is linear in the picture.
    other_depth = np.asarray(reading.seen(reading.planar(other.depth, directions)), dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(other_depth > 0.0, 1.0 / other_depth, 0.0).astype(np.float32)
    maps = (pixels[inside] - 0.5).astype(np.float32)
    apart = np.abs(colour[inside] - _sampled(np.ascontiguousarray(reading.seen(other.rgb)), maps)).mean(
        axis=1
    )
    same_colour = apart < max(_SAME_COLOUR, _SAME_COLOUR_SHARE * float(other.rgb.std(axis=(0, 1)).mean()))
    return there[inside, 2] * _sampled(inverse, maps), same_colour


def _require_unsaturated(here: Depth, ahead: Depth) -> None:
    """Raise for views before and after a move ahead in which many pixels share one largest depth: a surface would have come nearer."""
    farthest_m, also_m = (float(np.max(each, initial=0.0, where=np.isfinite(each))) for each in (here, ahead))
    share = min(float(np.mean(each == farthest_m)) for each in (here, ahead))
    # Flat ground up to the horizon ends in one row of pixels, whose planar depth is the same wherever the car stands.
    rows = int((here == farthest_m).any(axis=1).sum())
    if farthest_m == also_m and share > _SATURATED_SHARE and rows > _ROWS_OF_GROUND:
        raise NotMet(
            f"expected infinite depth where nothing is measured; {100 * share:.0f} % of a view is at its largest depth, {farthest_m:g} m, and stays there as the "
            "car drives ahead: the camera ends there; give infinity where nothing is measured"
        )


def _sampled(image: NDArray[np.float32], xy: NDArray[np.float32]) -> Array:
    """Values ``[N, ...]`` interpolated between pixels; in one column, as OpenCV limits rows to 32 767."""
    parts = np.array_split(xy, 1 + len(xy) // 30_000)
    values = [
        cv2.remap(image, part[:, :1], part[:, 1:], interpolation=cv2.INTER_LINEAR)[:, 0] for part in parts
    ]
    return np.concatenate(values).astype(np.float64)


def _points(bench: WorldBench, place: Pose) -> tuple[Array, Array]:
    """Points that the driving camera sees from a pose of the car, in the world ``[N, 3]`` [m], and their depth ``[N]`` [m]."""
    depth = np.asarray(bench.world.observe_at(*place)[1], dtype=np.float64)
    kept = slice(None, None, _EVERY_PX), slice(None, None, _EVERY_PX)
    z_m = depth[kept]
    known = np.isfinite(z_m)
    in_camera = bench.world.camera_pinhole.directions()[kept][known] * z_m[known][:, None]
    T = planar_pose(*place) @ bench.world.T_car_from_camera
    return transform_points(T, in_camera), z_m[known]
