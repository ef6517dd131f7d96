"""Fits a reference path of lines and circular arcs without kinks to a trace of the car or a wand.

The heading along such a path is piecewise linear in the distance, with slope zero on lines and one over the radius on arcs. So the
trace's heading is cut into pieces by dynamic programming (least squares of a line in each piece, a price for every cut), pieces of
little curvature become lines, and then all lengths and radii together are fitted to the trace's points by orthogonal distance. A
closed path closes exactly: the last step projects onto the closing condition.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from advnerf_core.driving.path import Arc, Line, Path
from advnerf_core.geometry import Array, wrap_angle
from calibration.degeneracy import DegenerateDataError

_STEP_M = 0.05
_SMOOTH_M = 0.30  # over which the heading is taken: a tracked point's noise of millimetres becomes a degree
_STRAIGHT_1PM = 0.1  # a radius over 10 m is a line
_CUT_PRICE_RAD2 = 0.02
_SHORTEST_PIECE_M = 0.20
_MEAN_PIECE_M = 0.5  # shorter pieces on average mean noise, not a track
_LEAST_LENGTH_M, _MOST_LENGTH_M = 1.0, 500.0
_MOST_PIECES = 80  # more take hours to fit, and no track of tape has them
# No pose in between: a car at 2 m/s is measured every 0.2 m at 10 Hz.
_MOST_JUMP_M = 0.5
# A car this far from the floor's level was lifted; less may be a tilted frame. Levels of the floor are told apart to half of it [m].
_LIFTED_M, _LEVEL_M = 0.15, 0.1
_CLOSING_WEIGHT = 100.0
_POINTS = 600
# Distance from its start at which a loop counts as closed [m].
_CLOSING_M = 0.3
# A fit with a larger error is rejected [m].
_WORST_RMS_M = 0.05
# A car that turned back within this had a turning radius of 0.2 m; small ones have 0.3 to 0.8 m.
_TURN_BACK_M, _TURN_BACK_RAD = 0.5, 2.4


@dataclass(frozen=True, eq=False)
class PathFit:
    """A fitted path.

    Attributes:
        path: Lines and arcs.
        trace: Points that it was fitted to ``[N, 2]`` [m].
        residuals_m: Signed distance of each from the path ``[N]`` [m].
        laps: Number of laps of the trace; 1 on an open path.
    """

    path: Path
    trace: Array
    residuals_m: Array
    laps: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the distances [m]."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))

    @property
    def worst_m(self) -> float:
        """Greatest distance [m]."""
        return float(np.abs(self.residuals_m).max())


def fit_path(trace: ArrayLike, closed: bool | None = None) -> PathFit:
    """Fit lines and arcs to a trace.

    Args:
        trace: Positions in the order of time ``[N, 2]`` [m]; standing still does no harm, a loop may be driven several times.
        closed: Whether the path is a loop; None detects whether the trace returns to its start.

    Raises:
        DegenerateDataError: The trace is too short, does not close as requested, or is not made of lines and arcs.
    """
    points = _thinned(np.asarray(trace, dtype=np.float64))
    lap_ends = _returns(points, _CLOSING_M)
    closed = bool(lap_ends) if closed is None else closed
    if closed and not lap_ends:
        gap_m = float(np.linalg.norm(points[-1] - points[0]))
        raise DegenerateDataError(
            f"expected a trace that comes back to within {_CLOSING_M:g} m of its start, its ends are {gap_m:.2f} m apart: "
            "drive the whole loop, or fit an open path"
        )
    first_lap = points[: lap_ends[0] + 1] if closed else points
    start, pieces = _pieces(first_lap, closed)
    length_m = sum(length for length, _ in pieces)
    if length_m < _MEAN_PIECE_M * (len(pieces) - 2) or len(pieces) > _MOST_PIECES:
        raise DegenerateDataError(
            f"this trace needs {len(pieces)} lines and arcs on {length_m:.1f} m: drive or draw it smoothly along the tape, at "
            "walking pace, in one direction"
        )
    path = _refined(start, pieces, points if closed else first_lap, closed)
    residuals = path.project(points[:, :2]).cte_m
    laps = len(points) * _STEP_M / path.length_m if closed else 1.0
    fit = PathFit(path, points, residuals, laps)
    if fit.rms_m > _WORST_RMS_M:
        raise DegenerateDataError(
            f"lines and arcs leave {1000 * fit.rms_m:.0f} mm rms of this trace (limit {1000 * _WORST_RMS_M:.0f} mm): drive "
            "or draw it smoothly along the tape, at walking pace, in one direction"
        )
    _require_along_trace(fit)
    _require_drivable(fit)
    return fit


def _require_along_trace(fit: PathFit) -> None:
    """Refuse a path with a part that was not driven: each of the trace's points is on it all the same."""
    xy = fit.path.pose_at(np.arange(0.0, fit.path.length_m, _STEP_M))[:, :2]
    away_m = cKDTree(fit.trace[:, :2]).query(xy)[0]
    worst = int(away_m.argmax())
    if away_m[worst] > _MOST_JUMP_M:
        raise DegenerateDataError(
            f"expected a path along the trace, got one whose point {xy[worst, 0]:.2f}, {xy[worst, 1]:.2f} m is {away_m[worst]:.2f} m from the nearest "
            "place of the trace: was the way driven there and back? Drive it in one direction"
        )


def _require_drivable(fit: PathFit) -> None:
    """Refuse a path that turns back on the spot, as one there and back does."""
    x_m, y_m, yaw_rad = fit.path.pose_at(np.arange(0.0, fit.path.length_m, _STEP_M)).T
    reach = round(_TURN_BACK_M / _STEP_M)
    turned_rad = np.abs(np.unwrap(yaw_rad)[reach:] - np.unwrap(yaw_rad)[:-reach])
    at = int(turned_rad.argmax())
    if turned_rad[at] > _TURN_BACK_RAD:
        raise DegenerateDataError(
            f"expected a path that a car can drive, got one that turns by {np.degrees(turned_rad[at]):.0f} degrees within {_TURN_BACK_M:g} m at "
            f"{x_m[at + reach // 2]:.2f}, {y_m[at + reach // 2]:.2f} m: was the way driven there and back? Drive it in one direction"
        )


def _thinned(xy: Array) -> Array:
    """Points ``[N, 2]`` every few centimetres along the trace; jitter on the spot adds no length."""
    if xy.ndim != 2 or xy.shape[1] != 2 or len(xy) < 2 or not np.isfinite(xy).all():
        raise DegenerateDataError(f"expected a trace of finite positions [N, 2], got shape {list(xy.shape)}")
    require_a_way(xy)
    kept = [xy[0]]
    for point in xy[1:]:
        gap = float(np.linalg.norm(point - kept[-1]))
        while gap >= _STEP_M:
            kept.append(kept[-1] + (point - kept[-1]) * (_STEP_M / gap))
            gap -= _STEP_M
    points = np.array(kept)
    if len(points) * _STEP_M < _LEAST_LENGTH_M:
        raise DegenerateDataError(
            f"expected a trace of at least {_LEAST_LENGTH_M:g} m, got {len(points) * _STEP_M:.2f} m: did the subject move?"
        )
    return points


def require_a_way(xy: Array, closed: bool = False) -> None:
    """Raise for jumps between neighbouring positions ``[N, 2]`` [m], of a closed way also between its ends, and for a length that no track has."""
    steps_m = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    if (jumps := steps_m[steps_m > _MOST_JUMP_M]).size:
        raise DegenerateDataError(
            f"expected neighbouring positions within {_MOST_JUMP_M:g} m, got {jumps.size} jumps of up to {jumps.max():.2f} m, the largest at "
            f"({xy[at := int(steps_m.argmax()), 0]:.2f}, {xy[at, 1]:.2f}) m: was the subject hidden, or mistaken for another? Drive or draw it again where "
            "all cameras see it, with positions in m"
        )
    if closed and (gap_m := float(np.linalg.norm(xy[-1] - xy[0]))) > _MOST_JUMP_M:
        raise DegenerateDataError(
            f"expected a walk that ends within {_MOST_JUMP_M:g} m of its start, got {gap_m:.2f} m: walk around all of the free floor, back to the start"
        )
    if (length_m := float(steps_m.sum())) > _MOST_LENGTH_M:
        raise DegenerateDataError(
            f"expected a trace of at most {_MOST_LENGTH_M:g} m, got {length_m:.4g} m: are its positions in m? Drive a loop once or twice"
        )


def driven_part(positions_m: ArrayLike) -> slice:
    """The part of a recorded lap in which the car stood on the floor; before and after it, the car was carried.

    The floor is where it moved furthest, and the longest way there is the part.

    Args:
        positions_m: Positions in the order of time ``[N, 3]`` [m].
    """
    points = np.asarray(positions_m, np.float64)
    steps_m = np.linalg.norm(np.diff(points[:, :2], axis=0, prepend=points[:1, :2]), axis=1)
    levels, which = np.unique(np.round(points[:, 2] / _LEVEL_M), return_inverse=True)
    level_m = _LEVEL_M * levels[np.bincount(which, steps_m).argmax()]
    on_floor = np.abs(points[:, 2] - level_m) <= _LIFTED_M
    edges = np.flatnonzero(np.diff(np.pad(on_floor, 1).astype(int))).reshape(-1, 2)
    first, end = max(edges, key=lambda part: steps_m[part[0] : part[1]].sum())
    return slice(int(first), int(end))


def require_forward(xy: Array, yaw_rad: Array) -> None:
    """Raise for a car, at positions ``[N, 2]`` [m] with headings ``[N]``, that was moved with its nose against the way."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    at = np.searchsorted(way_m, np.arange(0.0, way_m[-1], 2.0 * _STEP_M))
    chord = np.diff(xy[at], axis=0)
    against = np.abs(wrap_angle(yaw_rad[at[:-1]] - np.arctan2(chord[:, 1], chord[:, 0]))) > 0.5 * np.pi
    if len(against) and against.mean() > 0.5:
        raise DegenerateDataError(
            f"expected a car that drives forwards, got one whose nose points against its way on {100 * against.mean():.0f} % of it: the path would lead "
            "the other way. Drive or push it forwards, or turn the subject's x axis forwards in Tracker"
        )


def _returns(points: Array, closing_m: float) -> list[int]:
    """Indices at which a trace is back at its start, heading the same way; one for each lap."""
    away = np.linalg.norm(points - points[0], axis=1)
    heading = _headings(points)
    back: list[int] = []
    index = 0
    left = round(_LEAST_LENGTH_M / _STEP_M)
    while True:
        beyond = np.flatnonzero(away[index:] > 2.0 * closing_m)
        if not beyond.size:
            return back
        index += max(int(beyond[0]), left)
        near = np.flatnonzero(
            (away[index:] < closing_m) & (np.abs(wrap_angle(heading[index:] - heading[0])) < 0.8)
        )
        if not near.size:
            return back
        first = index + int(near[0])
        span = away[first : first + round(2.0 * closing_m / _STEP_M) + 1]
        index = first + int(np.argmin(span))
        back.append(index)


def _headings(points: Array) -> Array:
    """Continuous heading at each point ``[N]`` [rad], over a window."""
    half = max(1, round(0.5 * _SMOOTH_M / _STEP_M))
    at = np.arange(len(points))
    ahead, behind = np.minimum(at + half, len(points) - 1), np.maximum(at - half, 0)
    chord = points[ahead] - points[behind]
    return np.asarray(np.unwrap(np.arctan2(chord[:, 1], chord[:, 0])), dtype=np.float64)


def _pieces(points: Array, closed: bool) -> tuple[Array, list[tuple[float, float]]]:
    """Start pose ``[3]`` and (length [m], curvature [1/m]) of each piece."""
    heading = _headings(points)
    cuts = _cut(heading)
    pieces: list[tuple[float, float]] = []
    for begin, end in pairwise(cuts):
        slope = float(np.polyfit(np.arange(end - begin) * _STEP_M, heading[begin:end], 1)[0])
        pieces.append(((end - begin) * _STEP_M, slope if abs(slope) > _STRAIGHT_1PM else 0.0))
    pieces = _merged(pieces)
    first = 0
    if closed and len(pieces) > 1 and _alike(pieces[0][1], pieces[-1][1]):
        # The trace began in the middle of a piece: the path begins where that piece does.
        back_m = pieces[-1][0]
        first = max(len(points) - 1 - round(back_m / _STEP_M), 0)
        pieces = [(back_m + pieces[0][0], pieces[0][1]), *pieces[1:-1]]
    return np.array([*points[first], wrap_angle(heading[first])]), pieces


def _cut(heading: Array) -> list[int]:
    """Indices between which the heading is straight, first 0 and last N, by dynamic programming."""
    count, least = len(heading), round(_SHORTEST_PIECE_M / _STEP_M)
    s = np.arange(count + 1, dtype=np.float64)
    sums = [
        np.concatenate([[0.0], np.cumsum(v)])
        for v in (s[:-1], s[:-1] ** 2, heading, heading**2, s[:-1] * heading)
    ]
    best, back = np.full(count + 1, np.inf), np.zeros(count + 1, dtype=np.intp)
    best[0] = -_CUT_PRICE_RAD2
    for end in range(least, count + 1):
        begin = np.arange(0, end - least + 1)
        n = (end - begin).astype(np.float64)
        x, xx, y, yy, xy = (total[end] - total[begin] for total in sums)
        sxx, syy, sxy = xx - x * x / n, yy - y * y / n, xy - x * y / n
        cost = best[begin] + np.maximum(syy - sxy**2 / np.maximum(sxx, 1e-12), 0.0) + _CUT_PRICE_RAD2
        choice = int(np.argmin(cost))
        best[end], back[end] = cost[choice], begin[choice]
    cuts = [count]
    while cuts[-1] > 0:
        cuts.append(int(back[cuts[-1]]))
    return cuts[::-1]


def _alike(a: float, b: float) -> bool:
    return (a == 0.0) == (b == 0.0) and abs(a - b) <= 0.15 * max(abs(a), abs(b), 1e-9)


def _merged(pieces: list[tuple[float, float]]) -> list[tuple[float, float]]:
    merged: list[tuple[float, float]] = []
    for length, curvature in pieces:
        if merged and _alike(merged[-1][1], curvature):
            total = merged[-1][0] + length
            mean = (merged[-1][0] * merged[-1][1] + length * curvature) / total
            merged[-1] = (total, mean)
        else:
            merged.append((length, curvature))
    return merged


def _refined(start: Array, pieces: list[tuple[float, float]], points: Array, closed: bool) -> Path:
    """All numbers fitted together to the points, by orthogonal distance."""
    arcs = [k for k, (_, curvature) in enumerate(pieces) if curvature != 0.0]
    signs = np.sign([curvature for _, curvature in pieces])
    chosen = points[:: max(1, len(points) // _POINTS)]

    def unpack(p: Array) -> tuple[Array, Array, Array]:
        curvature = np.zeros(len(pieces))
        curvature[arcs] = signs[arcs] * np.exp(p[3 + len(pieces) :])
        return p[:3], np.exp(p[3 : 3 + len(pieces)]), curvature

    def gap(p: Array) -> Array:
        pose, lengths, curvatures = unpack(p)
        end = _end_pose(pose, lengths, curvatures) - pose
        return np.array([end[0], end[1], float(wrap_angle(end[2]))])

    def residual(p: Array) -> Array:
        pose, lengths, curvatures = unpack(p)
        path = _path(pose, lengths, curvatures, closed=False)
        cte = path.project(chosen).cte_m
        # An end that slides along its own line or arc changes no distance: it is held at the trace's end instead.
        ends = (
            []
            if closed
            else [path.pose_at(0.0)[:2] - chosen[0], path.pose_at(path.length_m)[:2] - chosen[-1]]
        )
        closing = _CLOSING_WEIGHT * gap(p) if closed else 0.3 * np.concatenate(ends)
        return np.concatenate([cte, closing])

    first = np.concatenate(
        [start, np.log([length for length, _ in pieces]), np.log(np.abs([pieces[k][1] for k in arcs]))]
    )
    # Wide, but a search that runs away must not overflow.
    reach = np.concatenate(
        [np.full(3, 1e3), np.full(len(pieces), np.log(300.0)), np.full(len(arcs), np.log(50.0))]
    )
    first = np.clip(first, -0.99 * reach, 0.99 * reach)
    p = least_squares(residual, first, x_scale="jac", max_nfev=100, bounds=(-reach, reach)).x
    if closed:
        p = _closed(p, gap)
    return _path(*unpack(p), closed=closed)


def _closed(p: Array, gap: object) -> Array:
    """The nearest parameters whose path ends exactly at its start (Gauss-Newton on three equations)."""
    assert callable(gap)
    for _ in range(20):
        miss = gap(p)
        if np.abs(miss).max() < 1e-12:
            break
        J = np.stack([(gap(p + h) - gap(p - h)) / 2e-6 for h in 1e-6 * np.eye(len(p))], axis=1)
        p = p - np.linalg.pinv(J) @ miss
    return p


def _end_pose(pose: Array, lengths: Array, curvatures: Array) -> Array:
    x, y, yaw = pose
    for length, curvature in zip(lengths, curvatures, strict=True):
        half = 0.5 * curvature * length
        chord = length * np.sinc(half / np.pi)
        x, y, yaw = x + chord * np.cos(yaw + half), y + chord * np.sin(yaw + half), yaw + 2.0 * half
    return np.array([x, y, yaw])


def _path(pose: Array, lengths: Array, curvatures: Array, closed: bool) -> Path:
    segments: list[Line | Arc] = []
    for length, curvature in zip(lengths, curvatures, strict=True):
        if curvature == 0.0:
            segments.append(Line(float(length)))
        else:
            angle = float(np.clip(length * curvature, -2.0 * np.pi, 2.0 * np.pi))
            segments.append(Arc(float(1.0 / abs(curvature)), angle))
    try:
        return Path.from_segments((float(pose[0]), float(pose[1]), float(pose[2])), segments, closed=closed)
    except ValueError as error:
        raise DegenerateDataError(f"the trace cannot be made into lines and arcs: {error}") from error
