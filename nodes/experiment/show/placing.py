"""Places an object by a rule: the first spot beside a path where it fits and is visible for long enough, or the one where it is largest for longest.

Placing by hand may use knowledge of the attack. This rule uses only the world's description, its depth, and the drive without an error
along the path; it runs while the world is photographed, before there is a learned scene or a victim.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from advnerf_core.driving.path import Path
from advnerf_core.geometry import Array, invert_transform, planar_pose
from hardware.worlds.paths import Pose
from hardware.worlds.world import Depth, World, require_depth
from nodes.experiment.plan.object_kinds import PANEL, footprint_m
from nodes.experiment.plan.placed import PlacedObject, RuledObject, in_a_lane
from nodes.experiment.show.context import Experiment
from nodes.runtime.errors import ConfigError

# In half lanes: steps along the path and away from it.
_ALONG, _AWAY = 0.25, 0.25
# Share of a panel's points that must be visible, the tolerance of the scene's depth, and the steepest view [cos].
_SEEN, _DEPTH_SHARE, _FACING = 0.9, 0.03, 0.3
_TURN_RAD = 0.2  # a path that turns by less is straight
_FACE = np.stack(np.meshgrid(*[np.linspace(-0.95, 0.95, 7)] * 2), axis=-1).reshape(
    -1, 2
)  # across and up, in half sides


@dataclass(frozen=True)
class SeenFrom:
    """View of the driving camera from one pose of the drive: ``T_camera_from_world`` and depth ``[H, W]`` [m]."""

    T_camera_from_world: Array
    depth_m: Depth


def place_by_rule(experiment: Experiment, world: World) -> list[PlacedObject]:
    """All objects of an experiment, with the places of those that have a rule in its open world.

    Raises:
        ConfigError: No spot fits the rule.
    """
    views: dict[str, list[SeenFrom]] = {}
    standing = [each for each in experiment.config.objects if isinstance(each, PlacedObject)]
    found: list[PlacedObject] = []
    for wanted in experiment.config.objects:
        if isinstance(wanted, PlacedObject):
            found.append(wanted)
            continue
        name = wanted.stands.path or experiment.config.paths[0]
        if name not in views:
            views[name] = list(_views(experiment, world, name))
        seen = views[name]
        fitting = (
            spot
            for spot in _spots(experiment, wanted, name)
            if _fits(experiment, spot, standing, seen, wanted)
        )
        if wanted.stands.choose == "first":
            spot = next(fitting, None)
        else:
            spot = max(
                fitting, key=partial(_total_px, experiment, seen, wanted.stands.least_px), default=None
            )
        if spot is None:
            raise ConfigError(
                f"{experiment.file}: expected a spot beside the path {name} where {wanted.name} fits and is seen for {wanted.stands.seen_s:g} s, got "
                "none; make it smaller (scale), let it be seen more briefly (stands.seen_s), or place it by hand (x_m, y_m)"
            )
        found.append(spot)
        standing.append(spot)
    return found


def clean_poses(experiment: Experiment, name: str) -> Array:
    """Poses ``[T + 1, 3]`` of a drive without an error."""
    path, config = experiment.paths[name], experiment.config
    start = np.array(experiment.references[name].drive_start[:2])
    begin_m = float(path.project(start[None]).s_m[0])
    along_m = begin_m + experiment.car.speed_mps * config.dt_s * np.arange(config.horizon + 1)
    return np.asarray(path.pose_at(along_m if path.closed else along_m[along_m <= path.length_m]))


def _views(experiment: Experiment, world: World, name: str) -> Iterator[SeenFrom]:
    for x_m, y_m, yaw_rad in clean_poses(experiment, name).tolist():
        T_world_from_camera = planar_pose(x_m, y_m, yaw_rad) @ experiment.mount
        _, depth_m = require_depth(world.observe_at(x_m, y_m, yaw_rad))
        yield SeenFrom(invert_transform(T_world_from_camera), depth_m)


def _spots(experiment: Experiment, wanted: RuledObject, name: str) -> Iterator[PlacedObject]:
    """Spots in the order of trial: along the drive, right before left, near before far."""
    path, half_lane_m = experiment.paths[name], experiment.world.off_track_m
    drive = clean_poses(experiment, name)
    ahead_m = wanted.stands.seen_s * experiment.car.speed_mps
    begin_m = float(path.project(drive[:1, :2]).s_m[0])
    length_m = float(np.hypot(*np.diff(drive[:, :2], axis=0).T).sum())
    sides = {"right": (-1.0,), "left": (1.0,), "either": (-1.0, 1.0), "outside": ()}[wanted.stands.side]
    away_m = (half_lane_m * np.arange(1.0, wanted.stands.within_half_lanes, _AWAY)).tolist()
    for passed_m in np.arange(ahead_m, length_m, _ALONG * half_lane_m).tolist():
        along_m = begin_m + passed_m
        if wanted.stands.side == "outside":
            turn_rad = float(
                np.subtract(*np.asarray(path.pose_at(np.array([along_m, along_m - ahead_m])))[:, 2])
            )
            turn_rad = math.remainder(turn_rad, 2.0 * math.pi)
            sides = (-math.copysign(1.0, turn_rad),) if abs(turn_rad) > _TURN_RAD else ()
        # It faces the car's position at the time when it must begin to be visible.
        for pose in poses_beside(path, along_m, along_m - ahead_m, sides, away_m):
            yield wanted.at(*pose)


def poses_beside(
    path: Path, along_m: float, facing_m: float, sides: Sequence[float], away_m: Sequence[float]
) -> Iterator[Pose]:
    """Poses beside a point of a path, near before far: at lateral distances ``away_m`` [m] to the ``sides`` (1: left, -1: right).

    They face the point of the path at ``facing_m``.
    """
    x, y, yaw = np.asarray(path.pose_at(along_m)).tolist()
    car = np.asarray(path.pose_at(facing_m))[:2]
    for side in sides:
        for each_m in away_m:
            at = np.array([x - side * each_m * math.sin(yaw), y + side * each_m * math.cos(yaw)])
            towards = car - at
            yield float(at[0]), float(at[1]), math.atan2(towards[1], towards[0])


def _fits(
    experiment: Experiment,
    spot: PlacedObject,
    standing: Sequence[PlacedObject],
    views: Sequence[SeenFrom],
    wanted: RuledObject,
) -> bool:
    """Whether a spot is beside the lanes, free of other objects, and visible long enough."""
    if in_a_lane([spot], experiment.world) is not None:
        return False
    for other in standing:
        if math.hypot(spot.x_m - other.x_m, spot.y_m - other.y_m) < _reach_m(spot) + _reach_m(other):
            return False
    needed, ticks = math.ceil((wanted.stands.seen_s - 1e-9) / experiment.config.dt_s), 0
    for passed, view in enumerate(views):
        if ticks >= needed or ticks + len(views) - passed < needed:  # decided
            break
        ticks += is_seen(experiment, spot, view, wanted.stands.least_px)
    return ticks >= needed


def _reach_m(spot: PlacedObject) -> float:
    """Half of the longest side of the ground that an object covers [m]."""
    return 0.5 * spot.scale * max(footprint_m(spot.kind))


def seen_from(experiment: Experiment, world: World, panel: PlacedObject, least_px: float) -> list[Pose]:
    """Poses of the drive without an error along the first path from which nearly all of a panel is visible."""
    name = experiment.config.paths[0]
    poses = [(float(x), float(y), float(yaw)) for x, y, yaw in clean_poses(experiment, name)]
    views = _views(experiment, world, name)
    return [
        pose for pose, view in zip(poses, views, strict=True) if is_seen(experiment, panel, view, least_px)
    ]


def seen_px(experiment: Experiment, spot: PlacedObject, view: SeenFrom, least_px: float) -> float:
    """Pixels of the policy's picture that an upright square of an object's width would cover there, facing the camera; 0 unless nearly all of it is visible."""
    if not is_seen(experiment, spot, view, least_px):
        return 0.0
    ahead_m = float((view.T_camera_from_world @ spot.T_world_from_face)[2, 3])
    return (spot.side_m * experiment.view.pinhole.fy / ahead_m) ** 2


def _total_px(
    experiment: Experiment, views: Sequence[SeenFrom], least_px: float, spot: PlacedObject
) -> float:
    """Pixels that an object covers, summed over the ticks of the drive; a panel covers less the more it is turned away."""
    total = 0.0
    for view in views:
        facing = 1.0
        if spot.kind == PANEL:
            T_camera_from_face = view.T_camera_from_world @ spot.T_world_from_face
            middle = T_camera_from_face[:3, 3]
            facing = float(-(middle @ T_camera_from_face[:3, 0]) / np.linalg.norm(middle))
        total += facing * seen_px(experiment, spot, view, least_px)
    return total


def is_seen(experiment: Experiment, spot: PlacedObject, view: SeenFrom, least_px: float) -> bool:
    """Whether nearly all of a panel is in the policy's window, in front of the scene, facing the camera and large enough."""
    T_camera_from_face = view.T_camera_from_world @ spot.T_world_from_face
    middle, normal = T_camera_from_face[:3, 3], T_camera_from_face[:3, 0]
    # The panel's middle alone decides for most spots.
    if middle[2] <= 0.0 or spot.side_m * experiment.view.pinhole.fy < least_px * middle[2]:
        return False
    if -(middle @ normal) < _FACING * math.sqrt(middle @ middle):
        return False
    points = middle + 0.5 * spot.side_m * _FACE @ T_camera_from_face[:3, 1:3].T
    if points[:, 2].min() <= 0.0:
        return False
    pinhole, window = experiment.camera, experiment.view.window
    columns, rows = (pinhole.project(points) - 0.5).round().astype(int).T
    inside = (
        (rows >= window[0].start)
        & (rows < window[0].stop)
        & (columns >= window[1].start)
        & (columns < window[1].stop)
    )
    if inside.mean() < _SEEN:
        return False
    depth_m = view.depth_m[rows[inside], columns[inside]]
    free = depth_m >= points[inside, 2] * (1.0 - _DEPTH_SHARE)
    return bool(free.sum() >= _SEEN * len(points))
