"""Possible places of an object in a learned place: beside the lane, in front of the learned surfaces, and large in the driver's view.

The rule uses the path and the learned scene's depth, but neither the policy nor any search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from advnerf_core.geometry import invert_transform, planar_pose
from nodes.audit.question import OBJECT
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.plan.object_kinds import footprint_m
from nodes.experiment.plan.placed import PlacedObject, in_a_lane
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import load_background, scene_sha256
from nodes.experiment.show.placing import SeenFrom, clean_poses, poses_beside, seen_px

# In half lanes: steps along the path and away from it, and the largest distance.
_ALONG, _AWAY, _FARTHEST = 0.5, 0.25, 4.0
# The object faces the car's position this long before it passes.
_LOOKS_AHEAD_S = 1.5
_LEAST_PX = 6.0
# Two spots are at least this many sides of the object apart.
_APART = 1.0


@dataclass(frozen=True)
class Spot:
    """One place for the object.

    Attributes:
        placed: The object at this place.
        seen_px: Pixels of the policy's picture that it covers, summed over the ticks of a drive without an error [px].
        seen_ticks: Ticks at which nearly all of it is visible.
        largest_tick: The tick at which it is largest in the picture.
    """

    placed: PlacedObject
    seen_px: float
    seen_ticks: int
    largest_tick: int


def best_spots(experiment: Experiment, kind: str, scale: float, count: int) -> list[Spot]:
    """The spots at which an object covers most of a drive's pictures, best first; at most ``count``."""
    scenario = experiment.config.paths[0]
    views = _views(experiment, scenario)
    found = []
    for placed in _places(experiment, scenario, kind, scale):
        if in_a_lane([placed], experiment.world) is None and (spot := _seen(experiment, placed, views)):
            found.append(spot)
    found.sort(key=lambda spot: -spot.seen_px)
    chosen: list[Spot] = []
    for spot in found:
        if all(_distance_m(spot, other) >= _APART * spot.placed.side_m for other in chosen):
            chosen.append(spot)
        if len(chosen) == count:
            break
    return chosen


def place_sha256(experiment: Experiment) -> str:
    """Hash of what `best_spots` chooses by beside the object: scene, path, lane, camera and the drive without an error."""
    scenario = experiment.config.paths[0]
    return hash_of(
        [
            scene_sha256(experiment),
            experiment.paths[scenario].to_dict(),
            experiment.world.off_track_m,
            experiment.mount.tolist(),
            vars(experiment.camera),
            clean_poses(experiment, scenario).tolist(),
        ]
    )


def _views(experiment: Experiment, scenario: str) -> list[SeenFrom]:
    """Views of the learned scene along a drive without an error."""
    render, views = load_background(experiment), []
    for x_m, y_m, yaw_rad in clean_poses(experiment, scenario).tolist():
        T_world_from_camera = planar_pose(x_m, y_m, yaw_rad) @ experiment.mount
        depth_m = np.asarray(render(T_world_from_camera[None], experiment.camera)[1][0], dtype=np.float32)
        views.append(SeenFrom(invert_transform(T_world_from_camera), depth_m))
    return views


def _places(experiment: Experiment, scenario: str, kind: str, scale: float) -> Iterator[PlacedObject]:
    path, half_lane_m = experiment.paths[scenario], experiment.world.off_track_m
    drive = clean_poses(experiment, scenario)
    begin_m = float(path.project(drive[:1, :2]).s_m[0])
    length_m = float(np.hypot(*np.diff(drive[:, :2], axis=0).T).sum())
    ahead_m = _LOOKS_AHEAD_S * experiment.car.speed_mps
    reach_m = 0.5 * scale * min(footprint_m(kind))
    end_m = begin_m + length_m + ahead_m if path.closed else min(path.length_m, begin_m + length_m + ahead_m)
    away_m = (reach_m + np.arange(1.0, _FARTHEST, _AWAY) * half_lane_m).tolist()
    for along_m in np.arange(begin_m + 0.5 * ahead_m, end_m, _ALONG * half_lane_m).tolist():
        for pose in poses_beside(path, along_m, max(begin_m, along_m - ahead_m), (-1.0, 1.0), away_m):
            x_m, y_m, yaw_rad = (round(each, 3) for each in pose)
            yield PlacedObject(name=OBJECT, kind=kind, x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, scale=scale)


def _seen(experiment: Experiment, placed: PlacedObject, views: Sequence[SeenFrom]) -> Spot | None:
    pixels = [seen_px(experiment, placed, view, _LEAST_PX) for view in views]
    ticks = sum(each > 0.0 for each in pixels)
    return Spot(placed, float(sum(pixels)), ticks, int(np.argmax(pixels))) if ticks else None


def _distance_m(one: Spot, other: Spot) -> float:
    return math.hypot(one.placed.x_m - other.placed.x_m, one.placed.y_m - other.placed.y_m)
