"""A chain of lines and arcs, continuous in position and heading, through the poses of a lane or through points."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import Array, wrap_angle
from hardware.worlds.paths import ReferencePath, Segment

# A lane's points are in single precision: a few hundred metres from the origin that is some 0.05 mm, and 1e-4 rad over half a metre.
_STRAIGHT_M = 2e-3
_STRAIGHT_RAD = 1e-3
_MAX_RADIUS_M = 1e5
_CLOSING_RADIUS_M = 1e8  # anything straighter than this misses its end by less than 1e-7 m over some metres
# No lane turns this far in one piece; if one seems to, its points do not belong together.
_MAX_TURN_RAD = 0.75 * math.pi


def fit_lines_and_arcs(poses: ArrayLike, tolerance_m: float = 0.02) -> tuple[Segment, ...]:
    """Lines and arcs that start at the first pose and pass the others within a tolerance.

    From the end of the chain, search the farthest pose that one line, or two arcs with a common tangent (a biarc), reaches
    without leaving the poses between by more than the tolerance. The next piece corrects the error of the last one.

    Args:
        poses: x [m], y [m], yaw [rad] ``[N, 3]`` in driving order, at least two, at most a few metres apart.
        tolerance_m: Largest distance of a pose from the chain [m].

    Raises:
        ValueError: Fewer than two poses, or they do not lie on one smooth route in driving order.
    """
    listed = np.asarray(poses, dtype=np.float64)
    if listed.ndim != 2 or listed.shape[1] != 3 or len(listed) < 2 or not np.isfinite(listed).all():
        raise ValueError(
            f"expected at least two finite poses [N, 3], got an array of shape {list(listed.shape)}"
        )
    here, done, segments = listed[0], 0, []
    while done < len(listed) - 1:
        reach, pieces = _farthest(here, listed[done + 1 :], tolerance_m)
        segments += pieces
        for piece in pieces:
            here = advance(here, piece)
        done += reach
    return tuple(_joined(segments))


def path_through(
    points_m: ArrayLike, goal: tuple[float, ...] = (), closed: bool = False, tolerance_m: float = 0.02
) -> ReferencePath:
    """The reference path through points.

    Args:
        points_m: x [m], y [m] ``[N, 2]`` in driving order, at least three, at most a few metres apart; the first one is not repeated at the
            end of a closed path.
        goal: Goal input of a goal-conditioned policy on this path.
        closed: Whether the path continues from the last point to the first.
        tolerance_m: Largest distance of a point from the path [m].

    Raises:
        ValueError: Too few points, a repeated point, or no smooth route through them.
    """
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
        raise ValueError(
            f"expected at least three finite points [N, 2], got an array of shape {list(points.shape)}"
        )
    if (
        not np.linalg.norm(
            np.diff(points, axis=0, append=points[:1] if closed else points[-1:] + 1.0), axis=1
        ).min()
        > 0
    ):
        raise ValueError(
            "expected points that differ from their neighbours, got one twice; leave out the second"
        )
    poses = np.column_stack([points, _headings(points, closed)])
    start = (float(poses[0, 0]), float(poses[0, 1]), float(poses[0, 2]))
    segments = list(fit_lines_and_arcs(poses, tolerance_m))
    if closed:
        here = poses[0]
        for segment in segments:
            here = advance(here, segment)
        segments += _closing(here, poses[0])
    return ReferencePath(start, tuple(segments), goal, closed)


def _headings(points: Array, closed: bool) -> Array:
    """Heading ``[N]`` [rad] at each of the points ``[N, 2]``: the tangent of the circle through it and its neighbours, exact on lines and arcs."""
    neighbours = np.concatenate([points[-1:], points, points[:1]]) if closed else points
    chords = np.diff(neighbours, axis=0)
    bearing, length = np.arctan2(chords[:, 1], chords[:, 0]), np.linalg.norm(chords, axis=1)
    turn = wrap_angle(np.diff(bearing))
    # On a circle the tangent divides the turn between two chords as their lengths.
    share = length[:-1] / (length[:-1] + length[1:])
    inner = bearing[:-1] + share * turn
    if closed:
        return inner
    # A chord's bearing is the mean of the headings at its ends.
    first, last = 2.0 * bearing[0] - inner[0], 2.0 * bearing[-1] - inner[-1]
    return np.concatenate([[first], inner, [last]])


def _closing(start: Array, end: Array) -> list[Segment]:
    """Pieces that end in a pose to rounding, as the last ones of a closed path must."""
    dx, dy = end[:2] - start[:2]
    c, s = math.cos(start[2]), math.sin(start[2])
    along, aside, turn = c * dx + s * dy, c * dy - s * dx, float(wrap_angle(end[2] - start[2]))
    if along <= 0.0 or abs(turn) > _MAX_TURN_RAD:
        raise ValueError(
            f"expected points that lead back to the first one on a smooth way, got {end[:2].round(2).tolist()} after "
            f"{start[:2].round(2).tolist()}"
        )
    return _biarc(float(along), float(aside), turn, max_radius_m=_CLOSING_RADIUS_M)


def advance(pose: ArrayLike, segment: Segment) -> Array:
    """The pose ``[3]`` at the end of a line or arc that starts at a pose ``[3]``."""
    x, y, yaw = np.asarray(pose, dtype=np.float64)
    turn = segment[2] if segment[0] == "arc" else 0.0
    chord = segment[1] if segment[0] == "line" else 2.0 * segment[1] * math.sin(0.5 * abs(turn))
    return np.array(
        [x + chord * math.cos(yaw + 0.5 * turn), y + chord * math.sin(yaw + 0.5 * turn), yaw + turn]
    )


def _farthest(here: Array, ahead: Array, tolerance_m: float) -> tuple[int, list[Segment]]:
    """Number of poses ahead that one piece covers, and the piece."""
    best, found = 1, _connect(here, ahead[0])
    step, reach = 1, 2
    # Doubling, then bisection: pieces are long and few.
    while step >= 1:
        pieces = _connect(here, ahead[reach - 1]) if reach <= len(ahead) else None
        if pieces is not None and _misses_m(here, pieces, ahead[:reach]) <= tolerance_m:
            best, found = reach, pieces
            step *= 2
        else:
            step //= 2
        reach = best + step
    if found is None:
        raise ValueError(
            f"expected poses on one smooth way, got {here.round(2).tolist()} and then {ahead[0].round(2).tolist()}"
        )
    return best, found


def _connect(start: Array, end: Array) -> list[Segment] | None:
    """A line if it ends at the pose well enough, else two arcs; None if the pose cannot be reached."""
    dx, dy = end[:2] - start[:2]
    c, s = math.cos(start[2]), math.sin(start[2])
    along, aside, turn = c * dx + s * dy, c * dy - s * dx, float(wrap_angle(end[2] - start[2]))
    if along <= 0.0 or abs(turn) > _MAX_TURN_RAD:
        return None
    if abs(aside) < _STRAIGHT_M and abs(turn) < _STRAIGHT_RAD:
        return [("line", float(along))]
    arcs = _biarc(float(along), float(aside), turn)
    return arcs if all(arc[0] == "line" or abs(arc[2]) <= _MAX_TURN_RAD for arc in arcs) else None


def _biarc(along: float, aside: float, turn: float, max_radius_m: float = _MAX_RADIUS_M) -> list[Segment]:
    """Two arcs from the origin, heading along x, to a point and heading, their tangents of equal length.

    With unit tangents ``t0, t1``, chord ``v`` and both tangent lengths ``d``: ``|v - d (t0 + t1)| = 2 d``, a quadratic in ``d``; the
    arcs meet in the middle between the tangents' ends.
    """
    t0, t1, v = np.array([1.0, 0.0]), np.array([math.cos(turn), math.sin(turn)]), np.array([along, aside])
    a, b, c = 2.0 * (1.0 - t0 @ t1), 2.0 * float(v @ (t0 + t1)), float(v @ v)
    # a d^2 + b d - c = 0, its positive root in the form that also holds for a = 0.
    d = 2.0 * c / (b + math.sqrt(b * b + 4.0 * a * c))
    joint = 0.5 * (v + d * (t0 - t1))
    # Heading where the arcs meet: a chord is half-way through its turn.
    middle = 2.0 * math.atan2(joint[1], joint[0])
    return [
        *_arc(joint, middle, max_radius_m),
        *_arc(v - joint, float(wrap_angle(turn - middle)), max_radius_m),
    ]


def _arc(chord: Array, turn: float, max_radius_m: float) -> list[Segment]:
    length = float(np.hypot(*chord))
    if length < 1e-9:
        return []
    if turn == 0.0 or abs(turn) * max_radius_m < length:
        return [("line", length)]
    return [("arc", length / (2.0 * math.sin(0.5 * abs(turn))), turn)]


def _misses_m(here: Array, pieces: list[Segment], poses: Array) -> float:
    """Largest distance of the poses from the pieces, matched in driving order [m]."""
    worst, start = np.full(len(poses), np.inf), here
    for piece in pieces:
        worst = np.minimum(worst, _distances_m(start, piece, poses))
        start = advance(start, piece)
    return float(worst.max())


def _distances_m(start: Array, piece: Segment, poses: Array) -> Array:
    offset = poses[:, :2] - start[:2]
    heading = np.array([math.cos(start[2]), math.sin(start[2])])
    left = np.array([-heading[1], heading[0]])
    ends = np.minimum(np.hypot(*offset.T), np.hypot(*(poses[:, :2] - advance(start, piece)[:2]).T))
    if piece[0] == "line":
        along = offset @ heading
        return np.where((along >= 0.0) & (along <= piece[1]), np.abs(offset @ left), ends)
    sign = math.copysign(1.0, piece[2])
    from_centre = offset - sign * piece[1] * left
    angle = np.arctan2(sign * (from_centre @ heading), -sign * (from_centre @ left))
    inside = (sign * angle >= 0.0) & (np.abs(angle) <= abs(piece[2]))
    return np.where(inside, np.abs(np.hypot(*from_centre.T) - piece[1]), ends)


def _joined(segments: list[Segment]) -> list[Segment]:
    """The same chain with neighbouring lines made one."""
    joined: list[Segment] = []
    for segment in segments:
        if joined and joined[-1][0] == "line" and segment[0] == "line":
            joined[-1] = ("line", joined[-1][1] + segment[1])
        else:
            joined.append(segment)
    return joined
