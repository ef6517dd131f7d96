"""A chain of lines and arcs, continuous in position and heading, through the poses of a lane."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import Array, wrap_angle
from hardware.worlds.junction.paths import Segment

# A lane's points are in single precision: a few hundred metres from the origin that is some 0.05 mm, and 1e-4 rad over half a metre.
_STRAIGHT_M = 2e-3
_STRAIGHT_RAD = 1e-3
_MAX_RADIUS_M = 1e5
_MAX_TURN_RAD = (
    0.75 * math.pi
)  # no lane turns so far in one piece; where one seems to, its points do not belong together


def fit_lines_and_arcs(poses: ArrayLike, tolerance_m: float = 0.02) -> tuple[Segment, ...]:
    """Lines and arcs that start at the first pose and pass the others within a tolerance.

    From wherever the chain stands, the farthest pose is sought that one line, or two arcs with a common tangent (a biarc), reach
    without leaving the poses between by more than the tolerance. What a piece misses, the next one makes up for.

    Args:
        poses: x [m], y [m], yaw [rad] ``[N, 3]`` in driving order, at least two, at most a few metres apart.
        tolerance_m: Largest distance of a pose from the chain [m].

    Raises:
        ValueError: There are fewer than two poses, or they are not in driving order on one smooth way.
    """
    listed = np.asarray(poses, dtype=np.float64)
    if listed.ndim != 2 or listed.shape[1] != 3 or len(listed) < 2 or not np.isfinite(listed).all():
        raise ValueError(f"expected at least two finite poses [N, 3], got an array of shape {list(listed.shape)}")
    here, done, segments = listed[0], 0, []
    while done < len(listed) - 1:
        reach, pieces = _farthest(here, listed[done + 1 :], tolerance_m)
        segments += pieces
        for piece in pieces:
            here = advance(here, piece)
        done += reach
    return tuple(_joined(segments))


def advance(pose: ArrayLike, segment: Segment) -> Array:
    """The pose ``[3]`` at the end of a line or arc that starts at a pose ``[3]``."""
    x, y, yaw = np.asarray(pose, dtype=np.float64)
    turn = segment[2] if segment[0] == "arc" else 0.0
    chord = segment[1] if segment[0] == "line" else 2.0 * segment[1] * math.sin(0.5 * abs(turn))
    return np.array([x + chord * math.cos(yaw + 0.5 * turn), y + chord * math.sin(yaw + 0.5 * turn), yaw + turn])


def _farthest(here: Array, ahead: Array, tolerance_m: float) -> tuple[int, list[Segment]]:
    """How many of the poses ahead one piece covers, and the piece."""
    best, found = 1, _connect(here, ahead[0])
    step, reach = 1, 2
    # Doubling, then closer and closer: pieces are long and few.
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
    """A line if it ends at the pose well enough, else two arcs; None if the pose cannot be driven to."""
    dx, dy = end[:2] - start[:2]
    c, s = math.cos(start[2]), math.sin(start[2])
    along, aside, turn = c * dx + s * dy, c * dy - s * dx, float(wrap_angle(end[2] - start[2]))
    if along <= 0.0 or abs(turn) > _MAX_TURN_RAD:
        return None
    if abs(aside) < _STRAIGHT_M and abs(turn) < _STRAIGHT_RAD:
        return [("line", float(along))]
    arcs = _biarc(float(along), float(aside), turn)
    return arcs if all(arc[0] == "line" or abs(arc[2]) <= _MAX_TURN_RAD for arc in arcs) else None


def _biarc(along: float, aside: float, turn: float) -> list[Segment]:
    """Two arcs from the origin, heading along x, to a point and heading, their tangents of equal length.

    With unit tangents ``t0, t1``, chord ``v`` and both tangent lengths ``d``: ``|v - d (t0 + t1)| = 2 d``, a quadratic in ``d``; the
    arcs meet in the middle between the tangents' ends.
    """
    t0, t1, v = np.array([1.0, 0.0]), np.array([math.cos(turn), math.sin(turn)]), np.array([along, aside])
    a, b, c = 2.0 * (1.0 - t0 @ t1), 2.0 * float(v @ (t0 + t1)), float(v @ v)
    # a d^2 + b d - c = 0, its positive root in the form that also holds for a = 0.
    d = 2.0 * c / (b + math.sqrt(b * b + 4.0 * a * c))
    joint = 0.5 * (v + d * (t0 - t1))
    middle = 2.0 * math.atan2(joint[1], joint[0])  # heading where the arcs meet: a chord is half-way through its turn
    return [*_arc(joint, middle), *_arc(v - joint, float(wrap_angle(turn - middle)))]


def _arc(chord: Array, turn: float) -> list[Segment]:
    length = float(np.hypot(*chord))
    if length < 1e-9:
        return []
    if abs(turn) * _MAX_RADIUS_M < length:
        return [("line", length)]
    return [("arc", length / (2.0 * math.sin(0.5 * abs(turn))), turn)]


def _misses_m(here: Array, pieces: list[Segment], poses: Array) -> float:
    """Largest distance of the poses from the pieces, both seen as they are driven [m]."""
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
