"""Stage deploy: every cell's drive in the deployment scene, tick by tick, with its own car and opaque objects."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from advnerf_core.attack.spaces.space import Space
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import load_policy
from hardware.worlds.world import World
from nodes.experiment.junction.attack import Cell, cells, frozen_hashes, load_shown
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.drives import deployed_drives, totals
from nodes.experiment.junction.policy import victim_file
from nodes.experiment.junction.spaces import make_space
from nodes.experiment.stages import hash_of
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.machine import machine_name
from nodes.runtime.progress import Report


class FrozenChangedError(RuntimeFault):
    """Something that was fixed before the first attack is no longer what it was."""


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Drive what is not driven yet; one ``.cell.json`` per entry of the transfer table."""
    check_frozen(experiment)
    searched, plan = experiment.stage_folder("attack"), cells(experiment)
    with experiment.open_world() as scene:
        space = make_space(experiment, scene)
        for index, cell in enumerate(plan):
            report(index / len(plan), f"{cell.scenario} {cell.victim} {cell.method} seed {cell.seed}")
            deployed_part(experiment, space, scene, cell, searched, folder)


def check_frozen(experiment: Experiment) -> None:
    """Refuse to drive if scene, victims, objects, places or starts are not those of the attack."""
    then = json.loads((experiment.stage_folder("attack") / "frozen.json").read_text())
    now = frozen_hashes(experiment)
    changed = [name for name, value in now.items() if name != "config" and then.get(name) != value]
    if changed:
        raise FrozenChangedError(
            f"expected {', '.join(changed)} as frozen before the first attack, got another; run the attack stage again"
        )


def deployed_part(
    experiment: Experiment, space: Space, scene: World, cell: Cell, searched: Path, folder: Path
) -> dict[str, Any]:
    """Drive a searched cell and its clean drive in the deployment scene; writes ``<cell>.cell.json`` and ``<cell>.drives.json``.

    Args:
        experiment: The experiment.
        space: What was searched.
        scene: Where it is deployed.
        cell: Which.
        searched: Where the surrogate's part is.
        folder: Where the result goes.

    Returns:
        Scenario, victim, method, seed, attack id, hash of all settings, seconds, machine, date; for ``surrogate`` and ``deployed``
        the total CTE [m] and whether the car left the track, per start, and the total CTE past the plain objects.
    """
    result = folder / f"{cell.name}.cell.json"
    if result.exists():
        found: dict[str, Any] = json.loads(result.read_text())
        return found
    learned, clean = (json.loads((searched / f"{each.name}.json").read_text()) for each in (cell, cell.clean))
    driven = _drives(experiment, space, scene, cell, searched, folder)
    undisturbed = _drives(experiment, space, scene, cell.clean, searched, folder)
    data = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "attack_id": learned["attack_id"],
        "settings_hash": hash_of(frozen_hashes(experiment)),
        "seconds": round(learned["seconds"], 1),
        "machine": machine_name(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "surrogate": _drives_of(learned, clean),
        "deployed": _drives_of(driven, undisturbed),
        "extra": {
            "evaluations": len(learned["curve_total_cte_m"]),
            "horizon": experiment.config.horizon,
            "blocked_tick": driven["blocked_tick"],
            "space": experiment.config.space.model_dump(mode="json"),
        },
    }
    write_atomically(result, json.dumps(data, indent=1) + "\n")
    return data


def _drives_of(found: Mapping[str, Any], clean: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "total_cte_m": found["total_cte_m"],
        "off_track": found["off_track"],
        "none_total_cte_m": clean["total_cte_m"],
    }


def _drives(
    experiment: Experiment, space: Space, scene: World, cell: Cell, searched: Path, folder: Path
) -> dict[str, Any]:
    """Deployed drives of a cell from all its starts; kept, as the clean ones are asked for again and again."""
    kept = folder / f"{cell.name}.drives.json"
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    policy = load_policy(victim_file(experiment, cell.victim)).policy
    starts = experiment.start_states(cell.scenario, cell.seed)
    shown = load_shown(space, searched, cell)
    there = DressedScene(scene, experiment.view, shown.objects)
    drives = deployed_drives(experiment, there, policy, cell.scenario, starts, shown.colours)
    data = {
        "states": [drive.states.tolist() for drive in drives],
        "controls": [drive.controls.tolist() for drive in drives],
        **totals([drive.metrics for drive in drives]),
        "mean_cte_m": [drive.metrics.mean_cte_m for drive in drives],
        "blocked_tick": [drive.blocked_tick for drive in drives],
    }
    write_atomically(kept, json.dumps(data) + "\n")
    return data
