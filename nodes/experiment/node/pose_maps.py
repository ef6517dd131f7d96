"""The landscape and the robustness map of a request with poses; both go on from their files in the folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from advnerf_core.attack.pose_maps import (
    Landscape,
    RobustnessMap,
    landscape,
    places_over,
    robustness_map,
    starts_beside,
)
from advnerf_core.attack.pose_plots import draw_landscape, draw_robustness
from advnerf_core.files import write_atomically
from nodes.experiment.node.poses import PreparedPoses, Report, prepare_poses
from nodes.experiment.node.request import AttackRequest
from nodes.runtime.errors import ConfigError


def make_landscape(
    request: AttackRequest, folder: Path, attack: Path | None, report: Report
) -> tuple[Landscape, Path]:
    """The landscape that the request asks for, and its picture; ``attack`` gives the colours and the other objects' places."""
    ready = prepare_poses(request)
    theta = _theta(ready, attack)
    asked = ready.asked.landscape
    if asked.object >= len(ready.asked.bounds):
        raise ConfigError(
            f"poses.landscape.object: expected 0..{len(ready.asked.bounds) - 1}, got {asked.object}"
        )
    place = ready.sensor.placements(theta)[asked.object]
    x_m, y_m = places_over(ready.sensor.space, asked.object, asked.points)
    found = landscape(
        ready.problem,
        theta,
        (x_m, y_m, asked.yaws_rad or (float(place[2]),)),
        asked.object,
        folder / "landscape.json",
        _telling(report),
        ready.settings_hash,
    )
    marked = {"here": (float(place[0]), float(place[1]))} if attack is not None else None
    picture = folder / "landscape.png"
    write_atomically(picture, draw_landscape(found, [ready.problem.path], marked))
    return found, picture


def make_robustness(
    request: AttackRequest, folder: Path, attack: Path | None, report: Report
) -> tuple[RobustnessMap, Path]:
    """The robustness map that the request asks for, and its picture; ``attack`` gives colours and places."""
    ready = prepare_poses(request)
    asked = ready.asked.robustness
    if asked.object >= len(ready.asked.bounds):
        raise ConfigError(
            f"poses.robustness.object: expected 0..{len(ready.asked.bounds) - 1}, got {asked.object}"
        )
    starts = starts_beside(ready.problem.start_states[0, :3].tolist(), asked.sideways_m, asked.turn_rad)
    moves = [(dx, dy, turn) for turn in asked.object_turns_rad for dx, dy in asked.object_moves_m]
    found = robustness_map(
        ready.problem,
        _theta(ready, attack),
        starts,
        moves,
        asked.object,
        folder / "robustness.json",
        _telling(report),
        ready.settings_hash,
    )
    picture = folder / "robustness.png"
    write_atomically(picture, draw_robustness(found))
    return found, picture


def _theta(ready: PreparedPoses, attack: Path | None) -> Tensor:
    """Of an attack file; without one, the objects stand where the request has them, in the request's colours."""
    if attack is not None:
        return ready.theta_of(attack)
    space = ready.sensor.space
    unit = torch.where(space.half > 0, (space.nominal - space.middle) / space.half.clamp_min(1e-300), 0.0)
    return ready.sensor.join(unit, ready.sensor.fixed_colours)


def _telling(report: Report) -> Callable[[int, int], None]:
    return lambda done, count: report(done / count, f"{done}/{count} cells")
