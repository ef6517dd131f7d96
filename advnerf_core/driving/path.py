"""Reference paths of straight lines and circular arcs, with signed cross-track error in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import wrap_angle

Array = NDArray[np.float64]

_WRITTEN = "{start_pose: [x_m, y_m, yaw_rad], segments: [{line_m: ...} or {arc_radius_m: ..., arc_angle_rad: ...}, ...], closed: true or false}"
# A closed path must return to its start with this accuracy [m and rad].
CLOSURE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Line:
    """A straight piece.

    Attributes:
        length_m: Length [m].
    """

    length_m: float

    def __post_init__(self) -> None:
        if not self.length_m > 0.0:
            raise ValueError(f"expected a line of positive length, got {self.length_m} m")

    @property
    def curvature_1pm(self) -> float:
        """Curvature of a line: zero."""
        return 0.0


@dataclass(frozen=True)
class Arc:
    """A circular piece.

    Attributes:
        radius_m: Radius [m], positive.
        angle_rad: Change of heading [rad], left positive, at most one turn.
    """

    radius_m: float
    angle_rad: float

    def __post_init__(self) -> None:
        if not (self.radius_m > 0.0 and 0.0 < abs(self.angle_rad) <= 2.0 * np.pi):
            raise ValueError(f"expected a radius > 0 and an angle of at most one turn, got {self}")

    @property
    def length_m(self) -> float:
        """Length along the arc [m]."""
        return self.radius_m * abs(self.angle_rad)

    @property
    def curvature_1pm(self) -> float:
        """Signed curvature [1/m], left positive."""
        return float(np.sign(self.angle_rad)) / self.radius_m


@dataclass(frozen=True)
class Projection:
    """Nearest path point of each query, arrays of the query's leading shape.

    Attributes:
        s_m: Distance along the path [m].
        cte_m: Signed cross-track error [m], left of the path positive.
        heading_rad: Path heading at the nearest point [rad], continuous along the path (not wrapped).
        curvature_1pm: Path curvature there [1/m], left positive.
        normal: Unit vector ``[..., 2]`` to the left of the path there; it is the gradient of ``cte_m`` in the plane.
    """

    s_m: Array
    cte_m: Array
    heading_rad: Array
    curvature_1pm: Array
    normal: Array


class Path:
    """A path that is continuous in position and heading.

    Build it with :meth:`from_segments` or :meth:`rounded_square`.

    Attributes:
        start_pose: Position [m] and heading [rad] at ``s = 0``.
        segments: Lines and arcs, in driving order.
        closed: Whether the end is the start.
        length_m: Total length [m].
    """

    def __init__(
        self, start_pose: tuple[float, float, float], segments: Sequence[Line | Arc], closed: bool
    ) -> None:
        if not segments:
            raise ValueError("expected at least one line or arc, got none")
        self.start_pose = (float(start_pose[0]), float(start_pose[1]), float(start_pose[2]))
        self.segments = tuple(segments)
        self.closed = closed
        self._lengths = np.array([segment.length_m for segment in self.segments])
        self._curvatures = np.array([segment.curvature_1pm for segment in self.segments])
        self._starts_s = np.concatenate([[0.0], np.cumsum(self._lengths)])
        self._poses = self._chain()  # [segments + 1, 3]
        self.length_m = float(self._starts_s[-1])
        if closed:
            self._check_closure()

    @classmethod
    def from_segments(
        cls, start_pose: tuple[float, float, float], segments: Sequence[Line | Arc], closed: bool = True
    ) -> Path:
        """Chain lines and arcs from a start pose (x [m], y [m], yaw [rad]); a closed path must end where it starts."""
        return cls(start_pose, segments, closed)

    @classmethod
    def rounded_square(cls, side_m: float, corner_radius_m: float) -> Path:
        """Square around the origin driven counter-clockwise, starting at the beginning of the bottom straight."""
        straight = side_m - 2.0 * corner_radius_m
        if not (corner_radius_m > 0.0 and straight > 0.0):
            raise ValueError(f"expected 0 < corner radius < side / 2, got {corner_radius_m} m and {side_m} m")
        corner = Arc(corner_radius_m, np.pi / 2.0)
        return cls((-straight / 2.0, -side_m / 2.0, 0.0), [Line(straight), corner] * 4, closed=True)

    def pose_at(self, s_m: ArrayLike) -> Array:
        """Poses ``[..., 3]`` (x [m], y [m], continuous heading [rad]) at distances ``s_m [...]`` along the path.

        On a closed path ``s_m`` may run on over several laps; on an open one it is clamped to the path.
        """
        s, laps = self._wrap(s_m)
        index = self._segment_of(s)
        pose = _advance(self._poses[index], self._curvatures[index], s - self._starts_s[index])
        pose[..., 2] += laps * (self._poses[-1, 2] - self._poses[0, 2])
        return pose

    def curvature_at(self, s_m: ArrayLike) -> Array:
        """Signed curvature ``[...]`` [1/m] at distances ``s_m [...]`` along the path."""
        return np.asarray(self._curvatures[self._segment_of(self._wrap(s_m)[0])], dtype=np.float64)

    def project(self, xy_m: ArrayLike) -> Projection:
        """Nearest point of the path for positions ``[..., 2]`` [m].

        Beyond the ends of an open path the error is measured from the straight extension. Where two parts of the path
        are equally near, the earlier one counts; there (and nowhere else near the path) the error is not differentiable.
        """
        xy = np.asarray(xy_m, dtype=np.float64)
        if xy.ndim == 0 or xy.shape[-1] != 2:
            raise ValueError(f"expected positions of shape [..., 2], got {list(xy.shape)}")
        along = self._nearest_on_each(xy)
        feet = _advance(self._poses[:-1], self._curvatures, along)
        nearest = np.sum((xy[..., None, :] - feet[..., :2]) ** 2, axis=-1).argmin(axis=-1)[..., None]
        best_s = np.take_along_axis(self._starts_s[:-1] + along, nearest, axis=-1)[..., 0]
        return self._describe(xy, best_s)

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which :meth:`from_dict` rebuilds the path."""
        pieces = [
            {"line_m": piece.length_m}
            if isinstance(piece, Line)
            else {"arc_radius_m": piece.radius_m, "arc_angle_rad": piece.angle_rad}
            for piece in self.segments
        ]
        return {"start_pose": list(self.start_pose), "segments": pieces, "closed": self.closed}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Path:
        """Rebuild a path from :meth:`to_dict`.

        Raises:
            ValueError: A key is missing, unknown, or has a value of another type.
        """
        if not isinstance(data, Mapping) or set(data) != {"start_pose", "segments", "closed"}:
            raise ValueError(f"expected a path {_WRITTEN}, got {data!r:.200}")
        if not isinstance(data["closed"], bool):
            raise ValueError(f"expected closed of a path to be true or false, got {data['closed']!r}")
        try:
            pieces = [_piece(piece) for piece in data["segments"]]
            x, y, yaw = map(_number, data["start_pose"])
        except (TypeError, ValueError) as error:
            raise ValueError(f"expected a path {_WRITTEN}, got {data!r:.200}: {error}") from error
        return cls((x, y, yaw), pieces, data["closed"])

    def _chain(self) -> Array:
        poses = [np.array(self.start_pose)]
        for curvature, length in zip(self._curvatures, self._lengths, strict=True):
            poses.append(_advance(poses[-1], curvature, np.asarray(length)))
        return np.stack(poses)

    def _check_closure(self) -> None:
        gap = self._poses[-1] - self._poses[0]
        gap[2] = wrap_angle(gap[2])
        if np.abs(gap).max() > CLOSURE_TOLERANCE:
            raise ValueError(
                f"expected a closed path to end at its start {self.start_pose}, got an end at {self._poses[-1].tolist()};"
                " change the segments, or say closed: false"
            )

    def _wrap(self, s_m: ArrayLike) -> tuple[Array, Array]:
        s = np.asarray(s_m, dtype=np.float64)
        if not self.closed:
            return np.clip(s, 0.0, self.length_m), np.zeros_like(s)
        laps = np.floor(s / self.length_m)
        return s - laps * self.length_m, laps

    def _segment_of(self, s: Array) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(self._starts_s, s, side="right") - 1, 0, len(self.segments) - 1)

    def _nearest_on_each(self, xy: Array) -> Array:
        """Distance along each segment of its point nearest to ``xy [..., 2]``, ``[..., segments]``."""
        along = np.empty((*xy.shape[:-1], len(self.segments)))
        for bent in (False, True):
            which = np.flatnonzero((self._curvatures != 0.0) == bent)
            on = self._nearest_on_arcs if bent else self._nearest_on_lines
            along[..., which] = on(
                which, xy[..., :1] - self._poses[which, 0], xy[..., 1:] - self._poses[which, 1]
            )
        return along

    def _nearest_on_lines(self, which: NDArray[np.intp], x: Array, y: Array) -> Array:
        yaw = self._poses[which, 2]
        return np.asarray(np.clip(x * np.cos(yaw) + y * np.sin(yaw), 0.0, self._lengths[which]), np.float64)

    def _nearest_on_arcs(self, which: NDArray[np.intp], x: Array, y: Array) -> Array:
        yaw, curvature = self._poses[which, 2], self._curvatures[which]
        turn, centre_x, centre_y = np.sign(curvature), -np.sin(yaw) / curvature, np.cos(yaw) / curvature
        # Angle travelled from the start of the arc, measured symmetrically about its middle so that clamping
        # sends each point to the nearer end.
        start_angle = np.arctan2(-centre_y, -centre_x)
        middle = 0.5 * self._lengths[which] * np.abs(curvature)
        angle = turn * (np.arctan2(y - centre_y, x - centre_x) - start_angle)
        travelled = middle + wrap_angle(angle - middle)
        return np.asarray(np.clip(travelled, 0.0, 2.0 * middle) / np.abs(curvature), np.float64)

    def _describe(self, xy: Array, s: Array) -> Projection:
        index = self._segment_of(s)
        pose = _advance(self._poses[index], self._curvatures[index], s - self._starts_s[index])
        normal = np.stack([-np.sin(pose[..., 2]), np.cos(pose[..., 2])], axis=-1)
        cte = np.sum(normal * (xy - pose[..., :2]), axis=-1)
        return Projection(s, cte, pose[..., 2], np.asarray(self._curvatures[index]), normal)


def _piece(data: Any) -> Line | Arc:
    """A segment of :meth:`Path.to_dict`."""
    if isinstance(data, Mapping) and set(data) == {"line_m"}:
        return Line(_number(data["line_m"]))
    if isinstance(data, Mapping) and set(data) == {"arc_radius_m", "arc_angle_rad"}:
        return Arc(_number(data["arc_radius_m"]), _number(data["arc_angle_rad"]))
    raise TypeError(f"no segment is {data!r:.100}")


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"no number is {value!r:.40}")
    return float(value)


def _advance(pose: Array, curvature: ArrayLike, distance: Array) -> Array:
    """Poses ``[..., 3]`` after driving ``distance [...]`` with constant curvature from ``pose [..., 3]``."""
    half = 0.5 * np.asarray(curvature) * distance
    chord = distance * np.sinc(half / np.pi)
    course = pose[..., 2] + half
    return np.stack(
        [pose[..., 0] + chord * np.cos(course), pose[..., 1] + chord * np.sin(course), course + half], axis=-1
    )
