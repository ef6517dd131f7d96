"""Maps of the total cross-track error: over the position of an object (a loss landscape), and over start and object poses (robustness).

Every cell is one closed-loop evaluation with true edges. Each finished cell is saved, so that an interrupted map resumes
to the bit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, evaluate
from advnerf_core.attack.search.poses import placed_sensor
from advnerf_core.attack.spaces.placement import PoseSpace, placed
from advnerf_core.documents import read_json
from advnerf_core.driving.cross_track import cross_track
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_json
from advnerf_core.geometry import Array

_FORMAT = "advnerf-pose-map-1"
OnCell = Callable[[int, int], None]
"""Called with the numbers of finished and of all cells."""


class PoseMapError(AdvnerfError, ValueError):
    """A map cannot be computed, or cannot be resumed from its file."""


@dataclass(frozen=True, eq=False)
class Landscape:
    """Total CTE over the place of one object, the others and all colours held.

    Attributes:
        x_m: ``[X]``.
        y_m: ``[Y]``.
        yaw_rad: ``[R]``.
        total_cte_m: Mean over the starts, by the protocol, ``[X, Y, R]`` [m]; NaN where the object would stand on the lane.
    """

    object: int
    x_m: Array
    y_m: Array
    yaw_rad: Array
    total_cte_m: Array


@dataclass(frozen=True, eq=False)
class RobustnessMap:
    """Total CTE over starts and moves of the objects.

    Attributes:
        starts: Start poses ``[S, 3]``: x [m], y [m], yaw [rad].
        moves: Offsets added to the placement of the moved object, ``[M, 3]``: x [m], y [m], yaw [rad].
        total_cte_m: With the attack ``[M, S]`` [m]; NaN where an object would stand on the lane.
        plain_cte_m: The same with plain colours.
        worst_cte_m: Largest |CTE| with the attack, ``[M, S]`` [m].
    """

    starts: Array
    moves: Array
    total_cte_m: Array
    plain_cte_m: Array
    worst_cte_m: Array


def places_over(space: PoseSpace, number: int, points: Sequence[int]) -> tuple[list[float], list[float]]:
    """x [m] and y [m] of a grid over the bounds of one object; a single one where they leave no room."""
    low, high = (space.middle + sign * space.half for sign in (-1, 1))
    x_m, y_m = (
        np.unique(np.linspace(float(low[number, k]), float(high[number, k]), n)).tolist()
        for k, n in enumerate(points)
    )
    return x_m, y_m


def starts_beside(
    nominal: Sequence[float], sideways_m: Sequence[float], turns_rad: Sequence[float] = (0.0,)
) -> list[tuple[float, float, float]]:
    """Starts to the left of a nominal one, each with each turn to the left: x [m], y [m], yaw [rad]."""
    x, y, yaw = nominal
    return [
        (x - aside * np.sin(yaw), y + aside * np.cos(yaw), yaw + turn)
        for turn in turns_rad
        for aside in sideways_m
    ]


def landscape(
    problem: AttackProblem,
    theta: Tensor,
    grid: tuple[Sequence[float], Sequence[float], Sequence[float]],
    number: int = 0,
    file: Path | None = None,
    on_cell: OnCell | None = None,
    settings_hash: str = "",
) -> Landscape:
    """Evaluate the drive with one object at each point of a grid.

    Args:
        problem: With a `PlacedSensor`.
        theta: Placements of all objects, and colours.
        grid: x [m], y [m] and yaw [rad] of the object's origin.
        file: File of finished cells; if it exists, the map resumes from it.
        on_cell: Called after every cell.
        settings_hash: Hash of scene, policy and configuration; a file of another one is refused.

    Raises:
        PoseMapError: A wrong object number, an empty grid, or the file of another map.
    """
    sensor = placed_sensor(problem)
    if not 0 <= number < len(sensor.space.objects):
        raise PoseMapError(f"expected an object of 0..{len(sensor.space.objects) - 1}, got {number}")
    axes = [np.asarray(axis, dtype=np.float64) for axis in grid]
    if any(axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all() for axis in axes):
        raise PoseMapError(f"expected three lists of finite numbers as a grid, got {grid}")
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    found = sensor.placements(theta)

    def total(index: int) -> list[float | None]:
        placements = found.clone()
        placements[number, :3] = torch.from_numpy(points[index])
        return _drive(problem, theta, placements)[0]

    names = {"kind": "landscape", "object": number, "grid": [axis.tolist() for axis in axes]}
    cells = _cells(len(points), total, file, _fingerprint(problem, theta, settings_hash, names), on_cell)
    shape = (len(axes[0]), len(axes[1]), len(axes[2]))
    return Landscape(number, axes[0], axes[1], axes[2], np.array(cells, float).mean(axis=1).reshape(shape))


def robustness_map(
    problem: AttackProblem,
    theta: Tensor,
    starts: Sequence[Sequence[float]],
    moves: Sequence[Sequence[float]],
    number: int = 0,
    file: Path | None = None,
    on_cell: OnCell | None = None,
    settings_hash: str = "",
) -> RobustnessMap:
    """Drive from other starts past displaced objects, with the attack's and with plain colours.

    Args:
        problem: With a `PlacedSensor`; with goals, all drives have the first.
        theta: Result of the search: placements and colours.
        starts: Start poses ``[S, 3]``: x [m], y [m], yaw [rad].
        moves: Offsets of the object, ``[M, 3]``: x [m], y [m], yaw [rad].
        file: File of finished rows; if it exists, the map resumes from it.
        on_cell: Called after every row of the map.
        settings_hash: Hash of scene, policy and configuration; a file of another one is refused.

    Raises:
        PoseMapError: A wrong object number, no starts or moves, or the file of another map.
    """
    sensor = placed_sensor(problem)
    begin, shifts = np.asarray(starts, dtype=np.float64), np.asarray(moves, dtype=np.float64)
    for rows in (begin, shifts):
        if rows.ndim != 2 or rows.shape[1] != 3 or not len(rows) or not np.isfinite(rows).all():
            raise PoseMapError(f"expected starts [S, 3] and moves [M, 3], finite, got {starts} and {moves}")
    if not 0 <= number < len(sensor.space.objects):
        raise PoseMapError(f"expected an object of 0..{len(sensor.space.objects) - 1}, got {number}")
    states = torch.nn.functional.pad(torch.from_numpy(begin), (0, problem.dynamics.state_size - 3))
    goals = None if problem.goals is None else problem.goals[:1].repeat(len(begin), 1)
    wide = replace(problem.undisturbed(), start_states=states.to(problem.start_states), goals=goals)
    plain = sensor.surrogate.plain_theta(torch.float64)
    found = sensor.placements(theta)

    def row(index: int) -> list[list[float | None]]:
        placements = found.clone()
        placements[number, :3] += torch.from_numpy(shifts[index])
        return [*_drive(wide, theta, placements), _drive(wide, theta, placements, plain)[0]]

    names = {"kind": "robustness", "object": number, "starts": begin.tolist(), "moves": shifts.tolist()}
    cells = np.array(
        _cells(len(shifts), row, file, _fingerprint(wide, theta, settings_hash, names), on_cell), float
    )
    return RobustnessMap(begin, shifts, cells[:, 0], cells[:, 2], cells[:, 1])


def _drive(
    problem: AttackProblem, theta: Tensor, placements: Tensor, colours: Tensor | None = None
) -> tuple[list[float | None], list[float | None]]:
    """Total CTE and largest |CTE| of each start with objects at ``placements``; None, which JSON can hold, if one of them is on the lane."""
    sensor = placed_sensor(problem)
    if not sensor.space.clear(placements):
        nothing: list[float | None] = [None] * len(problem.start_states)
        return nothing, nothing
    surrogate = sensor.surrogate.with_objects(placed(sensor.space.objects, placements))
    shown = (sensor.colours(theta) if colours is None else colours).to(surrogate.dtype)
    rollout, totals = evaluate(replace(problem.undisturbed(), sensor=surrogate), shown)
    worst = cross_track(problem.path, rollout.states[..., :2]).abs().amax(0)
    return totals.protocol_cte_m.tolist(), worst.tolist()


def _cells(
    count: int,
    evaluate_cell: Callable[[int], Any],
    file: Path | None,
    fingerprint: str,
    on_cell: OnCell | None,
) -> list[Any]:
    """All cells of a map, starting with the cells in the file."""
    done = {} if file is None or not file.exists() else _kept(file, fingerprint)
    for index in range(count):
        if index not in done:
            done[index] = evaluate_cell(index)
            if file is not None:
                content = {"format": _FORMAT, "fingerprint": fingerprint, "cells": done}
                write_json(file, content)
        if on_cell is not None:
            on_cell(index + 1, count)
    return [done[index] for index in range(count)]


def _kept(file: Path, fingerprint: str) -> dict[int, Any]:
    try:
        content = read_json(file)
        cells = {int(index): cell for index, cell in content["cells"].items()}
        made_of = (content["format"], content["fingerprint"])
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise PoseMapError(f"cannot go on from {file} ({error!r}); delete it to start afresh") from error
    if made_of != (_FORMAT, fingerprint):
        raise PoseMapError(f"{file} belongs to a map with other settings; delete it, or use another folder")
    return cells


def _fingerprint(problem: AttackProblem, theta: Tensor, settings_hash: str, names: dict[str, Any]) -> str:
    sensor = placed_sensor(problem)
    lane = sensor.space.keep_out
    clear = None if lane is None else [lane.clearance_m, *(path.to_dict() for path in lane.paths)]
    text = json.dumps({**names, "hash": settings_hash, "steps": problem.steps, "lane": clear}, sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for part in (sensor.placements(theta), sensor.colours(theta), problem.start_states):
        digest.update(part.detach().double().numpy().tobytes())
    return digest.hexdigest()
