"""The deployed part of a cell: drives past its attack, by the world's own car or through the live nodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from advnerf_core.attack.spaces.space import Space
from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.kept import kept_drives
from hardware.worlds.world import World
from nodes.experiment.engine.run_folder import ATTACK, SEARCHED, THETA
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import DeployedDrive
from nodes.experiment.show.drives import deployed_drives, totals
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import dress_cell
from nodes.experiment.steps.live import LiveNodes, LiveRun, as_drive, drive_until_it_counts
from nodes.lab.trials.tries import NotDrivenError

DRIVES = "drives.json"


def drive_through_world(
    experiment: Experiment, scene: World, space: Space, cell: Cell, folder: Path
) -> list[DeployedDrive]:
    """One drive per start by the open world's own car, tick by tick."""
    policy, starts = load_victim(experiment, cell.victim).policy, deployed_starts(experiment, cell)
    dressed, colours = dress_cell(experiment, scene, space, folder, cell)
    return deployed_drives(experiment, dressed, policy, cell.scenario, starts, colours)


def _through_nodes(
    experiment: Experiment, nodes: LiveNodes, cell: Cell, folder: Path, tell: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Measurements of one live drive per start, each with the folder of its bag."""
    attack = None if cell.method == NONE else (folder / ATTACK).resolve()
    found = []
    for number, start in enumerate(deployed_starts(experiment, cell).tolist()):
        name = live_name(number)
        live = LiveRun(name, cell.victim, cell.scenario, (start[0], start[1], start[2]), attack)
        driven = drive_until_it_counts(experiment, live, folder, tell, nodes)
        found.append({"run": name, **driven})
    return found


def live_name(start: int) -> str:
    """Name of the live run of a cell from one of its starts, in the cell's folder."""
    return f"live{start}"


def deployed_starts(experiment: Experiment, cell: Cell) -> torch.Tensor:
    """The deployed starts ``[B, 3]`` of a cell."""
    return experiment.measured_starts(cell.scenario)[: experiment.config.deploy.starts]


def cell_data(
    experiment: Experiment,
    space: Space,
    place: World | LiveNodes | None,
    cell: Cell,
    folder: Path,
    clean: Path,
    tell: Callable[[str], None],
    control_m: Sequence[float] = (),
) -> dict[str, Any]:
    """Drive a searched cell, and without attack, in the deployment, and assemble the result.

    Args:
        place: The open world, or the live nodes; None deploys nothing.
        folder: The cell's folder, with the surrogate's part.
        clean: The folder of the same drive without attack, with the surrogate's part.
        tell: Called with a message for each drive that does not count.
        control_m: Total CTE of each start without attack [m], if it was driven already; see `worker.Job`.

    Returns:
        Attack id; for ``surrogate`` and ``deployed`` the total CTE [m] and whether the car left the track, per start, and the total
        CTE without attack; see `advnerf_core.report.cells`. A cell that was not driven live has no ``deployed``, but the reason.
    """
    learned, undisturbed = (read_json(at / SEARCHED) for at in (folder, clean))
    data = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "attack_id": learned["attack_id"],
        "policy_sha256": learned["policy_sha256"],
        "surrogate": _drives_of(learned, undisturbed["total_cte_m"]),
        "kept": {"surrogate": kept_drives(learned)},
        "extra": {
            "evaluations": len(learned["curve_total_cte_m"]),
            "horizon": experiment.config.horizon,
            "space": experiment.config.space.model_dump(mode="json"),
            "deployed_through": experiment.config.deploy.through,
            "hardness": learned.get("hardness", ""),
            **({} if learned["attack_id"] is None else {"theta": THETA}),
            **({"objective": learned["objective"]} if "objective" in learned else {}),
        },
    }
    if place is not None:
        try:
            without_m = (
                control_m or _deployed_part(experiment, space, place, cell.clean, clean, tell)["total_cte_m"]
            )
            driven = _deployed_part(experiment, space, place, cell, folder, tell)
        except NotDrivenError as error:
            # Either arm can be the spoiled one. Without both there is nothing to compare, so the cell has no deployed drives at all.
            data["not_driven_live"] = str(error)
            data["extra"]["spoiled_tries"] = [list(error.spoiled)]
            return data
        data["deployed"] = _drives_of(driven, without_m)
        data["kept"]["deployed"] = kept_drives(driven)
        data["extra"] |= {
            "blocked_tick": driven["blocked_tick"],
            "max_abs_cte_m": max(driven["max_cte_m"]),
            "off_track_m": experiment.limits.off_track_m,
            **_live_extra(driven["live"]),
        }
    return data


def _drives_of(found: Mapping[str, Any], without_m: Sequence[float]) -> dict[str, Any]:
    return {
        "total_cte_m": found["total_cte_m"],
        "off_track": found["off_track"],
        "none_total_cte_m": list(without_m),
    }


def _live_extra(live: list[dict[str, Any]]) -> dict[str, Any]:
    """Values that only live drives have, per start."""
    if not live:
        return {}
    return {
        "stopped_early": [each["outcome"]["stopped_early"] for each in live],
        "missed_frames": [each["missed"] for each in live],
        "spoiled_tries": [each["spoiled"] for each in live],
        "time_to_leave_s": [each["metrics"]["time_to_leaving_s"] for each in live],
    }


def _deployed_part(
    experiment: Experiment,
    space: Space,
    place: World | LiveNodes,
    cell: Cell,
    folder: Path,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Deployed drives of a searched cell from its starts, stored in ``drives.json``; existing ones are read."""
    kept = folder / DRIVES
    if kept.exists():
        found: dict[str, Any] = read_json(kept)
        return found
    live: list[dict[str, Any]] = []
    if isinstance(place, LiveNodes):
        live = _through_nodes(experiment, place, cell, folder, tell)
        drives = [as_drive(experiment, each) for each in live]
    else:
        drives = drive_through_world(experiment, place, space, cell, folder)
    data = {
        "states": [drive.states.tolist() for drive in drives],
        "commands": [drive.controls.tolist() for drive in drives],
        **totals([drive.metrics for drive in drives]),
        "mean_cte_m": [drive.metrics.mean_cte_m for drive in drives],
        "max_cte_m": [drive.metrics.max_cte_m for drive in drives],
        "blocked_tick": [drive.blocked_tick for drive in drives],
        "collided_with": [drive.collided_with for drive in drives],
        "live": live,
    }
    write_atomically(kept, json.dumps(data) + "\n")
    return data
