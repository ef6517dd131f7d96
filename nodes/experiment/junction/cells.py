"""One entry of the transfer table, from the search to the deployed drive, as campaigns ask for it; a finished part is not done again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from advnerf_core.attack.methods import require_method
from advnerf_core.files import write_atomically
from advnerf_core.plugins import PluginError
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.conditions import NONE
from nodes.experiment.campaign.kinds import stage_digests
from nodes.experiment.junction.attack import Cell, cells, frozen_hashes, load_theta, surrogate_part
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.drives import deployed_drives, totals
from nodes.experiment.junction.films import film_cell, kept_film, with_film
from nodes.experiment.junction.objects import placed_objects, surrogate_of
from nodes.experiment.junction.policy import victim_file, victims
from nodes.experiment.stages import hash_of
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.machine import machine_name
from nodes.runtime.progress import Report

PREPARED_AT = "policy"  # the last stage that a cell needs of its experiment
TAKEN_FROM = "deploy"
# What a cell does not depend on: which others there are, how much memory may be used, and what is told of the world elsewhere.
_FREE: Mapping[str, bool | set[str]] = {
    "name": True,
    "scenarios": True,
    "retrain": True,
    "world": True,
    "attack": {"seeds", "methods", "cache_mib"},
}


class CellError(RuntimeFault):
    """A cell was asked for that this experiment does not have."""


def cell_inputs(experiment: Experiment, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
    """What a cell depends on: the resolved world (of a server, not its address), settings, and what the stages before it wrote.

    Raises:
        CellError: No such drive, victim or method.
    """
    del seed
    require_known(experiment, scenario, victims(experiment), victim, method)
    config = experiment.config.model_dump(mode="json", exclude=_FREE)
    return {"config": config, "world": experiment.site.settings, "stages": stage_digests(experiment.folder)}


def run_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> dict[str, Any]:
    """Search in the surrogate, drive in both domains, and keep the result in ``folder``.

    Args:
        experiment: Its scene, objects and policies must be there (``advnerf experiment FILE --until policy``).
        scenario: Drive: straight, right or left.
        victim: hardened or naive.
        method: none, or a method as `advnerf_core.attack.methods.load_method` takes it.
        seed: Of the search and its starts.
        folder: Where search states, attack files and results are kept.
        report: Told the finished fraction.

    Returns:
        The cell as JSON data: see `deployed_part`.

    Raises:
        CellError: No such drive, victim or method.
    """
    cell = search_cell(experiment, scenario, victim, method, seed, folder, report)
    result, film = folder / f"{cell.name}.cell.json", kept_film(folder)
    if result.exists() and film is not None:
        found: dict[str, Any] = json.loads(result.read_text())
        return with_film(found, film)
    with experiment.site.open() as scene:
        dressed = DressedScene(scene, experiment.view, placed_objects(experiment))
        data = deployed_part(experiment, dressed, cell, folder, folder)
        return with_film(data, film_cell(experiment, dressed, cell, folder))


def search_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> Cell:
    """The part of `run_cell` that needs no deployment scene: search and drive in the surrogate.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, scenario, victims(experiment), victim, method)
    cell = Cell.of(scenario, victim, method, seed)
    surrogate = surrogate_of(experiment, placed_objects(experiment))
    for each in dict.fromkeys((cell.clean, cell)):
        surrogate_part(experiment, surrogate, each, folder, report)
    return cell


def require_known(
    experiment: Experiment,
    scenario: str,
    victims: Sequence[str],
    victim: str,
    method: str,
    methods: Sequence[str] | None = None,
) -> None:
    """Refuse a cell that there cannot be.

    Args:
        experiment: The experiment.
        scenario: Which drive.
        victims: The victims that there are.
        victim: Which of them.
        method: none, or a method of attack.
        methods: Those that these cells can be searched with; None for all.

    Raises:
        CellError: No such drive, victim or method.
    """
    asked = [("scenario", scenario, experiment.config.scenarios), ("victim", victim, victims)]
    asked += [] if methods is None else [("method", method, methods)]
    for what, value, choices in asked:
        if value not in choices:
            raise CellError(f"expected a {what} of {', '.join(choices)}, got {value!r}")
    if method != NONE:
        try:
            require_method(method)
        except PluginError as error:
            raise CellError(str(error)) from None


def deployed_part(
    experiment: Experiment, dressed: DressedScene, cell: Cell, searched: Path, folder: Path
) -> dict[str, Any]:
    """Drive a searched cell and its clean drive in the deployment scene; writes ``<cell>.cell.json`` and ``<cell>.drives.json``.

    Args:
        experiment: The experiment.
        dressed: The scene with its objects.
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
    driven = _drives(experiment, dressed, cell, searched, folder)
    undisturbed = _drives(experiment, dressed, cell.clean, searched, folder)
    data = {
        "scenario": cell.scenario, "victim": cell.victim, "method": cell.method, "seed": cell.seed,
        "attack_id": learned["attack_id"], "settings_hash": hash_of(frozen_hashes(experiment)),
        "seconds": round(learned["seconds"], 1), "machine": machine_name(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "surrogate": {
            "total_cte_m": learned["total_cte_m"], "off_track": learned["off_track"], "none_total_cte_m": clean["total_cte_m"],
        },
        "deployed": {
            "total_cte_m": driven["total_cte_m"], "off_track": driven["off_track"],
            "none_total_cte_m": undisturbed["total_cte_m"],
        },
        "extra": {
            "evaluations": len(learned["curve_total_cte_m"]), "horizon": experiment.config.horizon,
            "blocked_tick": driven["blocked_tick"],
        },
    }  # fmt: skip
    write_atomically(result, json.dumps(data, indent=1) + "\n")
    return data


def _drives(experiment: Experiment, dressed: DressedScene, cell: Cell, searched: Path, folder: Path) -> dict[str, Any]:
    """Deployed drives of a cell from all its starts; kept, as the clean ones are asked for again and again."""
    kept = folder / f"{cell.name}.drives.json"
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    policy = load_policy(victim_file(experiment, cell.victim)).policy
    theta = dressed.plain_theta() if cell.method == NONE else load_theta(searched, cell)
    starts = experiment.start_states(cell.scenario, cell.seed)
    drives = deployed_drives(experiment, dressed, policy, cell.scenario, starts, theta)
    data = {
        "states": [drive.states.tolist() for drive in drives], "controls": [drive.controls.tolist() for drive in drives],
        **totals([drive.metrics for drive in drives]), "mean_cte_m": [drive.metrics.mean_cte_m for drive in drives],
        "blocked_tick": [drive.blocked_tick for drive in drives],
    }  # fmt: skip
    write_atomically(kept, json.dumps(data) + "\n")
    return data


__all__ = ["Cell", "CellError", "cell_inputs", "cells", "deployed_part", "require_known", "run_cell", "search_cell"]
