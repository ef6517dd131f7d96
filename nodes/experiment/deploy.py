"""Stage deploy: every cell's drives past what its search found, by the world's own car or through the live nodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch

from advnerf_core.attack.spaces.space import Space
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.conditions import NONE
from hardware.worlds.world import World
from nodes.experiment.attack import attack_path, cells, frozen_hashes, load_found, load_shown
from nodes.experiment.cell import Cell
from nodes.experiment.context import Experiment
from nodes.experiment.deployed import DeployedDrive
from nodes.experiment.drives import deployed_drives, totals
from nodes.experiment.live import LiveRun, as_drive, drive_until_it_counts, run_extras
from nodes.experiment.policy import HARDENED, victim_file
from nodes.experiment.spaces import dress, make_space, shown_there
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
    with ExitStack() as stack:
        deployer = open_deployer(experiment, stack)
        if isinstance(deployer, ThroughNodes):
            run_extras(experiment, HARDENED, folder, report)
        space = make_space(experiment, deployer.scene)
        for index, cell in enumerate(plan):
            told = partial(report, index / len(plan))
            told(f"{cell.scenario} {cell.victim} {cell.method} seed {cell.seed}")
            deployed_part(experiment, space, deployer, cell, searched, folder, told)


def check_frozen(experiment: Experiment) -> None:
    """Refuse to drive if scene, victims, objects, places or starts are not those of the attack."""
    then = json.loads((experiment.stage_folder("attack") / "frozen.json").read_text())
    now = frozen_hashes(experiment)
    changed = [name for name, value in now.items() if name != "config" and then.get(name) != value]
    if changed:
        raise FrozenChangedError(
            f"expected {', '.join(changed)} as frozen before the first attack, got another; run the attack stage again"
        )


class Deployer(Protocol):
    """Drives past what a search found."""

    @property
    def scene(self) -> World | None:
        """The world, if it is open."""

    def drive(
        self, space: Space, cell: Cell, searched: Path, folder: Path, tell: Callable[[str], None], /
    ) -> Deployed:
        """Drive a cell from the starts that are deployed; its attack file is in ``searched``, and what is kept goes to ``folder``."""


@dataclass(frozen=True, eq=False)
class Deployed:
    """Deployed drives of one cell.

    Attributes:
        drives: One per start.
        live: Of live drives what was measured in each bag, and in which folder it is.
    """

    drives: list[DeployedDrive]
    live: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class ThroughWorld:
    """The open world's own car, tick by tick."""

    experiment: Experiment
    scene: World

    def drive(
        self, space: Space, cell: Cell, searched: Path, folder: Path, tell: Callable[[str], None]
    ) -> Deployed:
        """Drive in this process; see `Deployer.drive`."""
        del folder, tell
        experiment = self.experiment
        policy = load_policy(victim_file(experiment, cell.victim)).policy
        shown = load_shown(space, searched, cell)
        there = dress(experiment, self.scene, shown)
        starts, colours = deployed_starts(experiment, cell), shown_there(shown, load_found(searched, cell))
        return Deployed(deployed_drives(experiment, there, policy, cell.scenario, starts, colours))


@dataclass(frozen=True, eq=False)
class ThroughNodes:
    """The live node graph; every drive leaves a bag."""

    experiment: Experiment
    scene: None = None

    def drive(
        self, space: Space, cell: Cell, searched: Path, folder: Path, tell: Callable[[str], None]
    ) -> Deployed:
        """Launch the nodes once per start; see `Deployer.drive`."""
        del space
        attack = None if cell.method == NONE else attack_path(searched, cell).resolve()
        found = []
        for number, start in enumerate(deployed_starts(self.experiment, cell).tolist()):
            name = live_name(cell, number)
            live = LiveRun(name, cell.victim, cell.scenario, (start[0], start[1], start[2]), attack)
            found.append({"run": name, **drive_until_it_counts(self.experiment, live, folder, tell)})
        return Deployed([as_drive(each) for each in found], found)


def live_name(cell: Cell, start: int) -> str:
    """Name of the live run of a cell from one of its starts."""
    return f"{cell.name}.live{start}"


def open_deployer(experiment: Experiment, stack: ExitStack, scene: World | None = None) -> Deployer:
    """What the section ``deploy`` asks for.

    Args:
        experiment: The experiment.
        stack: Closes the world again.
        scene: The world, if it is open already.
    """
    if experiment.config.deploy.live:
        return ThroughNodes(experiment)
    return ThroughWorld(experiment, scene or stack.enter_context(experiment.open_world()))


def deployed_starts(experiment: Experiment, cell: Cell) -> torch.Tensor:
    """The starts ``[B, 3]`` of a cell that are deployed."""
    return experiment.start_states(cell.scenario, cell.seed)[: experiment.config.deploy.starts]


def deployed_part(
    experiment: Experiment,
    space: Space,
    deployer: Deployer | None,
    cell: Cell,
    searched: Path,
    folder: Path,
    tell: Callable[[str], None],
    clean_folder: Path | None = None,
) -> dict[str, Any]:
    """Drive a searched cell and its clean drive where they are deployed; writes ``<cell>.cell.json`` and ``<cell>.drives.json``.

    Args:
        experiment: The experiment.
        space: What was searched.
        deployer: What drives; None deploys nothing.
        cell: Which.
        searched: Where the surrogate's part is.
        folder: Where the result goes.
        tell: Told of drives that do not count.
        clean_folder: Where the clean drives go, which several cells share; None: where the result goes.

    Returns:
        Scenario, victim, method, seed, attack id, hash of all settings, seconds, machine, date; for ``surrogate`` and ``deployed``
        the total CTE [m] and whether the car left the track, per start, and the total CTE past the plain objects.
    """
    result = folder / f"{cell.name}.cell.json"
    if result.exists():
        found: dict[str, Any] = json.loads(result.read_text())
        return found
    learned, clean = (json.loads((searched / f"{each.name}.json").read_text()) for each in (cell, cell.clean))
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
        "extra": {
            "evaluations": len(learned["curve_total_cte_m"]),
            "horizon": experiment.config.horizon,
            "space": experiment.config.space.model_dump(mode="json"),
            "deployed_through": experiment.config.deploy.through,
        },
    }
    if deployer is not None:
        undisturbed = _drives(space, deployer, cell.clean, searched, clean_folder or folder, tell)
        driven = (
            undisturbed if cell.method == NONE else _drives(space, deployer, cell, searched, folder, tell)
        )
        data["deployed"] = _drives_of(driven, undisturbed)
        data["extra"] |= {"blocked_tick": driven["blocked_tick"], **_live_extra(driven["live"])}
    write_atomically(result, json.dumps(data, indent=1) + "\n")
    return data


def _drives_of(found: Mapping[str, Any], clean: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "total_cte_m": found["total_cte_m"],
        "off_track": found["off_track"],
        "none_total_cte_m": clean["total_cte_m"],
    }


def _live_extra(live: list[dict[str, Any]]) -> dict[str, Any]:
    """What only live drives can tell, per start."""
    if not live:
        return {}
    return {
        "stopped_early": [each["outcome"]["stopped_early"] for each in live],
        "missed_frames": [each["missed"] for each in live],
        "time_to_leave_s": [each["metrics"]["time_to_leaving_s"] for each in live],
    }


def _drives(
    space: Space, deployer: Deployer, cell: Cell, searched: Path, folder: Path, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Deployed drives of a cell from its starts; kept, as the clean ones are asked for again and again."""
    kept = drives_file(folder, cell)
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    folder.mkdir(parents=True, exist_ok=True)
    deployed = deployer.drive(space, cell, searched, folder, tell)
    data = {
        "states": [drive.states.tolist() for drive in deployed.drives],
        "controls": [drive.controls.tolist() for drive in deployed.drives],
        **totals([drive.metrics for drive in deployed.drives]),
        "mean_cte_m": [drive.metrics.mean_cte_m for drive in deployed.drives],
        "blocked_tick": [drive.blocked_tick for drive in deployed.drives],
        "live": deployed.live,
    }
    write_atomically(kept, json.dumps(data) + "\n")
    return data


def drives_file(folder: Path, cell: Cell) -> Path:
    """Where the deployed drives of a cell are kept."""
    return folder / f"{cell.name}.drives.json"
