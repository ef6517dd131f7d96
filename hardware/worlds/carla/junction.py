"""Junctions of a CARLA map, and the drives straight on, right and left through one of them.

Everything is read from the map's OpenDRIVE waypoints, so it works offline with ``carla.Map(name, text)`` too. The waypoints' order is
the direction of driving. Right-handed coordinates (CARLA's with y mirrored) from the moment they are read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.geometry import Array, wrap_angle
from hardware.worlds.carla.config import JunctionConfig
from hardware.worlds.carla.drives import JunctionDrives
from hardware.worlds.carla.errors import CarlaMapError
from hardware.worlds.carla.frames import CarlaPose, SceneFrame
from hardware.worlds.fitting import fit_lines_and_arcs
from hardware.worlds.junction.paths import PathName, goal_of
from hardware.worlds.paths import ReferencePath

_STRAIGHT_RAD = math.radians(30.0)
_TURN_RAD = (math.radians(50.0), math.radians(130.0))
_SAMPLE_M = 1.0
_SAME_LANE_M = 0.5


@dataclass(frozen=True)
class Crossing:
    """One lane through a junction.

    Attributes:
        begin: Waypoint (``carla.Waypoint``) at the entry.
        end: Waypoint at the exit.
        entry: x [m], y [m], yaw [rad] of ``begin``.
        exit: The same of ``end``.
    """

    begin: Any
    end: Any
    entry: Array
    exit: Array

    @property
    def turn_rad(self) -> float:
        """Change of heading [rad], left positive."""
        return float(wrap_angle(self.exit[2] - self.entry[2]))


@dataclass(frozen=True)
class JunctionInfo:
    """A map's facts about a junction.

    Attributes:
        id: OpenDRIVE id.
        x_m: Middle, in CARLA's axes [m].
        y_m: Middle, in CARLA's axes [m].
        arms: Roads that lead into it.
        drives: Number of matching sets of a straight, a right and a left drive.
    """

    id: int
    x_m: float
    y_m: float
    arms: int
    drives: int


def list_junctions(carla_map: Any, library: Any) -> list[JunctionInfo]:
    """All junctions of a map, by id."""
    infos = []
    for number, junction in sorted(_junctions(carla_map).items()):
        crossings = _crossings(junction, library)
        at = junction.bounding_box.location
        infos.append(JunctionInfo(number, at.x, at.y, _arms(crossings), len(_sets_of_three(crossings))))
    return infos


def _arms(crossings: Sequence[Crossing]) -> int:
    """Number of roads that the lanes come from; lanes with the same heading belong to one road."""
    headings: list[float] = []
    for crossing in crossings:
        heading = float(crossing.entry[2])
        if all(abs(float(wrap_angle(heading - other))) > _STRAIGHT_RAD for other in headings):
            headings.append(heading)
    return len(headings)


def find_drives(carla_map: Any, library: Any, wanted: JunctionConfig) -> JunctionDrives:
    """The drives through one junction, on ground that is flat enough for a car that moves in a plane.

    Args:
        carla_map: A ``carla.Map``.
        library: The ``carla`` module.

    Raises:
        CarlaMapError: The map has no such junction, or its roads are too short or not flat enough.
    """
    candidates, reasons = _candidates(carla_map, library, wanted.id), []
    for junction in candidates:
        try:
            drives = _drives_at(junction, library, wanted)
            if drives.height_range_m <= wanted.max_height_range_m:
                return drives
            reasons.append(
                f"expected a flat junction, heights within {wanted.max_height_range_m:g} m, got {drives.height_range_m:.2f} m at junction "
                f"{drives.junction_id}; take another one (`advnerf scene carla junctions`), or shorter roads"
            )
        except CarlaMapError as error:
            reasons.append(str(error))
    more = f" (none of {len(candidates)} junctions will do; this is the first)" if len(candidates) > 1 else ""
    raise CarlaMapError(reasons[0] + more)


def _drives_at(junction: Any, library: Any, wanted: JunctionConfig) -> JunctionDrives:
    sets = _sets_of_three(_crossings(junction, library))
    if wanted.choice >= len(sets):
        raise CarlaMapError(
            f"expected one of the {len(sets)} sets of drives of junction {junction.id} (0 to {len(sets) - 1}), got {wanted.choice}"
        )
    three = sets[wanted.choice]
    frame, waypoints = _frame_of(three), {}
    for name, crossing in three.items():
        waypoints[name] = _along(crossing, frame, wanted, f"the drive {name} of junction {junction.id}")
    heights = np.array([point.transform.location.z for points in waypoints.values() for point in points])
    x, y = (float(value) for value in frame.T_mirrored_from_world[:2, 3])
    frame = SceneFrame(x, y, float(np.median(heights)), frame.yaw_rad)
    paths = {name: _path(name, points, frame) for name, points in waypoints.items()}
    width = min(point.lane_width for points in waypoints.values() for point in points)
    return JunctionDrives(
        junction.id, frame, paths, float(width), float(np.ptp(heights)), bool(three["straight"].begin.is_rht)
    )


def _junctions(carla_map: Any) -> dict[int, Any]:
    found: dict[int, Any] = {}
    for ends in carla_map.get_topology():
        for waypoint in ends:
            if waypoint.is_junction and waypoint.junction_id not in found:
                found[waypoint.junction_id] = waypoint.get_junction()
    return found


def _candidates(carla_map: Any, library: Any, junction_id: int | None) -> list[Any]:
    junctions = _junctions(carla_map)
    if junction_id is not None:
        if junction_id not in junctions:
            raise CarlaMapError(
                f"expected junction {junction_id} in the map {carla_map.name}, which has {sorted(junctions) or 'none'}; "
                "`advnerf scene carla junctions` lists them"
            )
        return [junctions[junction_id]]
    fit = [info.id for info in list_junctions(carla_map, library) if info.arms == 3 and info.drives]
    if not fit:
        raise CarlaMapError(
            f"expected a junction of three roads in the map {carla_map.name}, found none: name a map that has one, or a crossing's id "
            "in junction.id"
        )
    return [junctions[each] for each in fit]


def _crossings(junction: Any, library: Any) -> list[Crossing]:
    pairs = junction.get_waypoints(library.LaneType.Driving)
    crossings = [Crossing(begin, end, _pose(begin), _pose(end)) for begin, end in pairs]
    # The map's order is arbitrary; sorting by position makes it repeatable.
    return sorted(crossings, key=lambda c: (*np.round(c.entry[:2], 2), *np.round(c.exit[:2], 2)))


def _sets_of_three(crossings: Sequence[Crossing]) -> list[dict[PathName, Crossing]]:
    """Every straight drive, the right turn from the same lane, and the left turn out of the road that the right turn leads to."""
    sets: list[dict[PathName, Crossing]] = []
    lowest, highest = _TURN_RAD
    for straight in crossings:
        if abs(straight.turn_rad) > _STRAIGHT_RAD:
            continue
        rights = [
            c
            for c in crossings
            if -highest < c.turn_rad < -lowest and _apart(c.entry, straight.entry) < _SAME_LANE_M
        ]
        for right in rights[:1]:
            lefts = [
                c
                for c in crossings
                if lowest < c.turn_rad < highest
                and _opposite(c.entry, right.exit)
                and _opposite(c.exit, straight.entry)
            ]
            if lefts:
                left = min(lefts, key=_nearness(right.exit, straight.entry))
                sets.append({"straight": straight, "right": right, "left": left})
    return sorted(sets, key=lambda three: round(float(wrap_angle(three["straight"].entry[2] + 1e-3)), 2))


def _nearness(entry_by: Array, exit_by: Array) -> Callable[[Crossing], float]:
    return lambda crossing: _apart(crossing.entry, entry_by) + _apart(crossing.exit, exit_by)


def _frame_of(three: dict[PathName, Crossing]) -> SceneFrame:
    """x along the straight drive; the origin where the middles of the two roads meet."""
    straight, right, left = three["straight"], three["right"], three["left"]
    ahead = straight.exit[:2] - straight.entry[:2]
    yaw = math.atan2(ahead[1], ahead[0])
    x_axis, y_axis = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    main = 0.5 * (straight.entry[:2] + left.exit[:2])
    side = 0.5 * (right.exit[:2] + left.entry[:2])
    origin = (side @ x_axis) * x_axis + (main @ y_axis) * y_axis
    return SceneFrame(float(origin[0]), float(origin[1]), 0.0, yaw)


def _along(crossing: Crossing, frame: SceneFrame, wanted: JunctionConfig, what: str) -> list[Any]:
    """Waypoints from the start of a drive, through the junction, to its end."""
    to_middle = float((frame.T_mirrored_from_world[:2, 3] - crossing.entry[:2]) @ _heading(crossing.entry))
    approach_m = wanted.approach_m
    if approach_m < to_middle:
        raise CarlaMapError(
            f"expected {what} to start before it, at least {to_middle:.1f} m from its middle, got approach_m = {approach_m:.1f} m"
        )
    before = _walk(crossing.begin, approach_m - to_middle, backwards=True, what=what)
    inside = [
        point
        for point in crossing.begin.next_until_lane_end(_SAMPLE_M)
        if _distance_m(point, crossing.end) > 0.3
    ]
    after = _walk(crossing.end, wanted.beyond_m, backwards=False, what=what)
    return [*reversed(before), crossing.begin, *inside, crossing.end, *after]


def _walk(start: Any, length_m: float, backwards: bool, what: str) -> list[Any]:
    """Waypoints from ``start``, taking the straightest branch at each fork; the last one is ``length_m`` away."""
    points: list[Any] = []
    here, left = start, length_m
    while left > 1e-6:
        step = min(_SAMPLE_M, left)
        options = here.previous(step) if backwards else here.next(step)
        if not options:
            side = "before" if backwards else "behind"
            raise CarlaMapError(
                f"expected {length_m:.1f} m of road {side} the junction for {what}, found {length_m - left:.1f} m; take another "
                f"junction or a shorter {'approach_m' if backwards else 'beyond_m'}"
            )
        heading = _pose(here)[2]
        here = min(options, key=lambda option: abs(float(wrap_angle(_pose(option)[2] - heading))))
        points.append(here)
        left -= step
    return points


def _path(name: PathName, waypoints: Sequence[Any], frame: SceneFrame) -> ReferencePath:
    poses = []
    for waypoint in waypoints:
        T = frame.world_from_body(CarlaPose.of(waypoint.transform))
        poses.append((T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])))
    start = (float(poses[0][0]), float(poses[0][1]), float(poses[0][2]))
    try:
        segments = fit_lines_and_arcs(poses)
    except ValueError as error:
        raise CarlaMapError(
            f"the lanes of the drive {name} do not join: {error}; take another junction"
        ) from error
    return ReferencePath(start, segments, goal_of(name))


def _pose(waypoint: Any) -> Array:
    at = CarlaPose.of(waypoint.transform)
    return np.array([at.x_m, -at.y_m, float(wrap_angle(-math.radians(at.yaw_deg)))])


def _heading(pose: Array) -> Array:
    return np.array([math.cos(pose[2]), math.sin(pose[2])])


def _apart(one: Array, other: Array) -> float:
    return float(np.hypot(*(one[:2] - other[:2])))


def _opposite(one: Array, other: Array) -> bool:
    """Whether two poses head against each other, give or take the skew of a junction."""
    return abs(abs(float(wrap_angle(one[2] - other[2]))) - math.pi) < _STRAIGHT_RAD


def _distance_m(one: Any, other: Any) -> float:
    return float(one.transform.location.distance(other.transform.location))
