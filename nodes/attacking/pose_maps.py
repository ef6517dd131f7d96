"""The landscape and the robustness map of a request with poses; both go on from their files in the folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.pose_maps import Landscape, RobustnessMap, landscape, robustness_map
from advnerf_core.attack.pose_plots import draw_landscape, draw_robustness
from advnerf_core.files import write_atomically
from nodes.attacking.poses import PreparedPoses, Report, prepare_poses
from nodes.attacking.request import AttackRequest
from nodes.runtime.errors import ConfigError


def make_landscape(request: AttackRequest, folder: Path, attack: Path | None, report: Report) -> tuple[Landscape, Path]:
    """The landscape that the request asks for, and its picture; ``attack`` gives the colours and the other objects' places."""
    ready = prepare_poses(request)
    theta = _theta(ready, attack)
    asked = ready.asked.landscape
    if asked.object >= len(ready.asked.bounds):
        raise ConfigError(f"poses.landscape.object: expected 0..{len(ready.asked.bounds) - 1}, got {asked.object}")
    place = ready.sensor.placements(theta)[asked.object]
    low, high = (ready.sensor.space.middle + s * ready.sensor.space.half for s in (-1, 1))
    axes = [
        np.linspace(float(low[asked.object, k]), float(high[asked.object, k]), n) for k, n in enumerate(asked.points)
    ]
    axes = [np.unique(axis) for axis in axes]
    found = landscape(
        ready.problem, theta, (axes[0].tolist(), axes[1].tolist(), asked.yaws_rad or (float(place[2]),)), asked.object,
        folder / "landscape.json", _telling(report), ready.settings_hash,
    )  # fmt: skip
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
        raise ConfigError(f"poses.robustness.object: expected 0..{len(ready.asked.bounds) - 1}, got {asked.object}")
    x, y, yaw = ready.problem.start_states[0, :3].tolist()
    starts = [
        (x - aside * np.sin(yaw), y + aside * np.cos(yaw), yaw + turn)
        for turn in asked.turn_rad
        for aside in asked.sideways_m
    ]
    moves = [(dx, dy, turn) for turn in asked.object_turns_rad for dx, dy in asked.object_moves_m]
    found = robustness_map(
        ready.problem, _theta(ready, attack), starts, moves, asked.object, folder / "robustness.json", _telling(report),
        ready.settings_hash,
    )  # fmt: skip
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
