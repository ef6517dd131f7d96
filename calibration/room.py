"""Measures the room with motion capture: the fence from a walk, the start before a corner, and the corners of a target.

It uses equipment that a lab has anyway: the car driven by hand, or a wand with a known tip.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.driving.path import Arc, Path
from advnerf_core.geometry import Array, invert_transform, transform_points, wrap_angle
from calibration.degeneracy import DegenerateDataError
from calibration.path_fit import require_a_way
from calibration.schema import CORNERS, TargetCalibration, measured

_CELL_M = 0.01
_LARGEST_ROOM_M = 50.0
_SIMPLIFY_M = 0.03
_STILL_M = 0.004
_STILL_S = 0.8
# Greatest cosine with the vertical of an upright face's normal, and the least of its upward side.
_UPRIGHT = 0.5
# A wand that is on the average farther behind the face than this part of its height was not held from the front.
_BEHIND = 0.05
_RECTANGLE_M = 0.01


def fence_from_trace(trace: ArrayLike, margin_m: float) -> tuple[tuple[float, float], ...]:
    """Polygon ``[n][2]`` [m] a margin inside of a closed walk around the free floor.

    Args:
        trace: Positions in the order of time ``[N, 2]`` [m].
        margin_m: Distance of the fence inside the walk [m].

    Raises:
        DegenerateDataError: The walk jumps or does not close, so that the fence would be across floor that nobody has seen to be free; or it
            encloses nothing, or less than the margin.
    """
    xy = _finite(trace)
    require_a_way(xy, closed=True)
    canvas, origin = _canvas(xy, 0.2)
    # What the walk keeps apart from the outside. Filled as a polygon, a second lap would empty the first.
    walked = cv2.polylines(np.pad(canvas, 1), [_to_pixels(xy, origin) + 1], True, 1)
    cv2.floodFill(walked, None, (0, 0), 2)
    enclosed = (walked != 2).astype(np.uint8)
    inside = cv2.distanceTransform(enclosed, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] * _CELL_M
    return _outline((inside > margin_m).astype(np.uint8), origin, f"inside of a margin of {margin_m:g} m")


def fence_around(path: Path, margin_m: float) -> tuple[tuple[float, float], ...]:
    """Polygon ``[n][2]`` [m] a margin outside of a path; for a loop its inside is included."""
    xy = path.pose_at(np.linspace(0.0, path.length_m, 1000))[:, :2]
    canvas, origin = _canvas(xy, margin_m + 0.2)
    pixels = _to_pixels(xy, origin)
    if path.closed:
        cv2.fillPoly(canvas, [pixels], 1)
    else:
        cv2.polylines(canvas, [pixels], False, 1)
    away = cv2.distanceTransform(1 - canvas, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * _CELL_M
    return _outline((away < margin_m).astype(np.uint8), origin, "around the path")


def clearance(path: Path, fence: ArrayLike) -> float:
    """Smallest distance of a path to the inside of a fence [m]; negative if it leaves it."""
    polygon = np.asarray(fence, np.float32)[:, None]
    points = path.pose_at(np.linspace(0.0, path.length_m, 1000))[:, :2].astype(np.float32)
    return min(cv2.pointPolygonTest(polygon, (float(x), float(y)), True) for x, y in points)


def start_before_corner(path: Path, corner: int, before_m: float) -> tuple[float, float, float]:
    """Pose on a path a distance before one of its arcs.

    Args:
        corner: Number of the arc, from 1.
        before_m: Distance along the path [m].
    """
    starts = np.concatenate([[0.0], np.cumsum([piece.length_m for piece in path.segments])])
    corners = [float(s) for s, piece in zip(starts, path.segments, strict=False) if isinstance(piece, Arc)]
    if not corners:
        raise DegenerateDataError(
            f"expected a path with corners, one of which the start is {before_m:g} m before, got a straight one; record a way with a turn"
        )
    if not 1 <= corner <= len(corners):
        raise DegenerateDataError(
            f"expected a corner from 1 to {len(corners)}, the arcs of the path, got {corner}"
        )
    s = corners[corner - 1] - before_m
    if not path.closed and s < 0.0:
        raise DegenerateDataError(
            f"expected {before_m:g} m of path before corner {corner}, there are {corners[corner - 1]:.2f} m"
        )
    x, y, yaw = path.pose_at(s % path.length_m if path.closed else s)
    return round(float(x), 4), round(float(y), 4), round(float(wrap_angle(yaw)), 4)


def target_of_size(
    subject: str,
    size_m: tuple[float, float],
    centre_m: tuple[float, float, float],
    normal_yaw_rad: float,
    method: str,
) -> TargetCalibration:
    """An upright rectangle in its subject's frame, from a ruler.

    Args:
        size_m: Width and height [m].
        centre_m: Middle of the rectangle in the subject's frame [m].
        normal_yaw_rad: Direction of its normal, about the subject's z axis [rad]; 0 is along x.
    """
    if not (min(size_m) > 0.0 and np.isfinite([*size_m, *centre_m, normal_yaw_rad]).all()):
        raise DegenerateDataError(
            f"expected a width and a height > 0, and finite numbers, got {size_m[0]:g} x {size_m[1]:g} m at {centre_m}, turned by {normal_yaw_rad:g} rad"
        )
    # Seen from the front, left is the side of the negative y axis of the face's frame.
    right = np.array([-np.sin(normal_yaw_rad), np.cos(normal_yaw_rad), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    half_w, half_h = 0.5 * size_m[0], 0.5 * size_m[1]
    corners = [
        np.asarray(centre_m) + x * half_w * right + z * half_h * up
        for x, z in ((-1, 1), (1, 1), (1, -1), (-1, -1))
    ]
    return _target(subject, np.array(corners), method, None, {})


@dataclass(frozen=True, eq=False)
class Touches:
    """Points at which a wand's tip was held still.

    Attributes:
        points_in_subject_m: ``[K, 3]`` in the order of time [m].
        spread_m: Standard deviation of each ``[K]`` [m].
        on_the_way_m: Mean position of the tip on its ways between them ``[3]`` [m]: in front of a face that a person touches.
        up: The world's vertical in the subject's frame ``[3]``.
    """

    points_in_subject_m: Array
    spread_m: Array
    on_the_way_m: Array
    up: Array


def find_touches(
    stamps_ns: NDArray[np.int64],
    T_world_from_wand: Array,
    T_world_from_subject: Array,
    tip_in_wand_m: ArrayLike,
) -> Touches:
    """Moments at which the wand's tip rested, in the subject's frame.

    Args:
        stamps_ns: ``[N]`` [ns].
        T_world_from_wand: ``[N, 4, 4]``.
        T_world_from_subject: ``[N, 4, 4]`` at the same moments.
        tip_in_wand_m: Position of the tip in the wand's frame ``[3]`` [m].
    """
    tip = np.asarray(tip_in_wand_m, dtype=np.float64)
    tips = np.stack(
        [
            transform_points(invert_transform(subject) @ wand, tip)
            for wand, subject in zip(T_world_from_wand, T_world_from_subject, strict=True)
        ]
    )
    seconds = (stamps_ns - stamps_ns[0]) / 1e9
    points, spreads, begin = [], [], 0
    moving = np.ones(len(tips), np.bool_)
    for index in range(1, len(tips) + 1):
        moved = (
            index == len(tips)
            or np.linalg.norm(tips[index] - np.median(tips[begin:index], axis=0)) > _STILL_M
        )
        if not moved:
            continue
        if seconds[index - 1] - seconds[begin] >= _STILL_S:
            rest = tips[begin:index]
            points.append(rest.mean(axis=0))
            spreads.append(float(rest.std(axis=0).max()))
            moving[begin:index] = False
        begin = index
    way = tips[moving].mean(axis=0) if moving.any() else np.full(3, np.nan)
    up = T_world_from_subject[:, 2, :3].mean(axis=0)
    return Touches(np.array(points).reshape(-1, 3), np.array(spreads), way, np.asarray(up))


def target_of_touches(subject: str, touches: Touches) -> TargetCalibration:
    """A target from its four corners, touched in the order top left, top right, bottom right, bottom left.

    The corners become the nearest rectangle; their distance from it is recorded.

    Raises:
        DegenerateDataError: Not four touches, no rectangle in that order, or the order of an upright face's other corner or of its back.
    """
    points = touches.points_in_subject_m
    if len(points) != 4:
        raise DegenerateDataError(
            f"expected the wand to rest at four corners for {_STILL_S:g} s each ({', '.join(CORNERS)}), found {len(points)} rests"
        )
    middle = points.mean(axis=0)
    across = 0.5 * (points[1] - points[0] + points[2] - points[3])
    down = 0.5 * (points[3] - points[0] + points[2] - points[1])
    width, height = float(np.linalg.norm(across)), float(np.linalg.norm(down))
    if min(width, height) < 0.05:
        raise DegenerateDataError(
            f"expected a face, the corners span {width:.3f} x {height:.3f} m: touched in another order?"
        )
    right = across / width
    down = down - (down @ right) * right
    down /= np.linalg.norm(down)
    half = 0.5 * np.array([[-width, -height], [width, -height], [width, height], [-width, height]])
    corners = middle + half[:, :1] * right + half[:, 1:] * down
    off = np.linalg.norm(corners - points, axis=1)
    if off.max() > _RECTANGLE_M:
        worst = CORNERS[int(off.argmax())]
        raise DegenerateDataError(
            f"expected four corners of a rectangle, the {worst} one is {1000 * off.max():.0f} mm off: touch them again in the order "
            f"{', '.join(CORNERS)}, as seen from the front"
        )
    _require_order(touches, middle, right, down, height)
    residuals = {
        "rectangle_mm": round(1000.0 * float(off.max()), 3),
        "rest_mm": round(1000.0 * float(touches.spread_m.max()), 3),
    }
    return _target(subject, corners, "touched with a wand", 4, residuals)


def _require_order(touches: Touches, middle: Array, right: Array, down: Array, height_m: float) -> None:
    """Raise for an order of corners by which the face would be upside down, on its side, or seen from its back."""
    outward = np.cross(down, right)
    upright = abs(float(outward @ touches.up)) < _UPRIGHT
    fallen = upright and -float(down @ touches.up) < _UPRIGHT
    behind = float((touches.on_the_way_m - middle) @ outward) < -_BEHIND * height_m
    if fallen or behind:
        got = "its top beside or below its bottom" if fallen else "a wand that came from behind it"
        raise DegenerateDataError(
            f"expected the corners in the order {', '.join(CORNERS)}, as seen from the front, got {got}; touch them again in that order"
        )


def _target(
    subject: str, corners: Array, method: str, views: int | None, residuals: dict[str, float]
) -> TargetCalibration:
    rows = tuple(tuple(round(float(v), 5) for v in corner) for corner in corners)
    return measured(
        TargetCalibration,
        date=datetime.date.today(),
        method=method,
        subject=subject,
        corners_in_subject_m=rows,
        views=views,
        residuals=residuals,
    )


def _finite(trace: ArrayLike) -> Array:
    xy = np.asarray(trace, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2 or len(xy) < 3 or not np.isfinite(xy).all():
        raise DegenerateDataError(
            f"expected a trace of finite positions [N >= 3, 2], got shape {list(xy.shape)}"
        )
    return xy


def _canvas(xy: Array, margin_m: float) -> tuple[NDArray[np.uint8], Array]:
    low, high = xy.min(axis=0) - margin_m, xy.max(axis=0) + margin_m
    if (high - low).max() > _LARGEST_ROOM_M:
        raise DegenerateDataError(
            f"expected a room of at most {_LARGEST_ROOM_M:g} m, the trace spans {(high - low).max():.0f} m"
        )
    columns, rows = np.ceil((high - low) / _CELL_M).astype(int) + 1
    return np.zeros((rows, columns), np.uint8), low


def _to_pixels(xy: Array, origin: Array) -> NDArray[np.int32]:
    return np.round((xy - origin) / _CELL_M).astype(np.int32)[:, None]


def _outline(mask: NDArray[np.uint8], origin: Array, what: str) -> tuple[tuple[float, float], ...]:
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        raise DegenerateDataError(f"no floor is left {what}: walk around all of it, or take a smaller margin")
    largest = max(contours, key=cv2.contourArea)
    corners = cv2.approxPolyDP(largest, _SIMPLIFY_M / _CELL_M, True)[:, 0]
    if len(corners) < 3:
        raise DegenerateDataError(f"no floor is left {what}: walk around all of it, or take a smaller margin")
    return tuple((round(float(x), 3), round(float(y), 3)) for x, y in origin + corners * _CELL_M)
