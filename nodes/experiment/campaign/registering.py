"""Registering an experiment or a campaign: what will be run is written down before it is run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path

from advnerf_core.driving.metrics import mean_cte_limit_m
from advnerf_core.files import write_atomically
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.registration import (
    FILE,
    PrimaryTest,
    RegisteredScenario,
    Registration,
    RegistrationError,
    read_registration,
    scenario_key,
)
from nodes.experiment.attack import planned_evaluations
from nodes.experiment.campaign.config import Campaign
from nodes.experiment.campaign.plan import read_experiment, statuses
from nodes.experiment.campaign.store import FINISHED
from nodes.experiment.cell import Cell
from nodes.experiment.cell_kind import CellKind
from nodes.experiment.context import Experiment
from nodes.experiment.keys import registered_settings
from nodes.experiment.kinds import load_kind
from nodes.experiment.policy import HARDENED
from nodes.experiment.registered import registered_cell
from nodes.experiment.stage_record import hash_of

_CLAIMED = "gradient"  # the method that primary tests are about


def register(campaign: Campaign, setting: str, overrides: Sequence[str], published: Path) -> Registration:
    """Write down what a campaign, or one experiment, will run.

    Args:
        campaign: The cells.
        setting: Of the experiment file; empty for a campaign.
        overrides: Changes on the command line.
        published: Folder of all published sets; the file goes into a folder of the campaign's name.

    Raises:
        RegistrationError: Other things are registered under this name, or cells of these settings were run already.
    """
    found = Registration(
        name=campaign.name,
        file=campaign.file.name,
        setting=setting,
        overrides=tuple(overrides),
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        software_version=version("advnerf"),
        scenarios=_scenarios(campaign),
        cells=tuple(registered_cell(cell) for cell in campaign.cells),
        primary=tuple(_primary(campaign.cells)),
        contrasts=campaign.contrasts,
    )
    folder = published / campaign.name
    before = read_registration(folder)
    if before is not None and before.digest == found.digest:
        return before
    if before is not None:
        raise RegistrationError(
            f"{folder / FILE}: expected the same experiment as was registered on {before.date}, got another; remove the file, and the cells "
            "published beside it, to register anew"
        )
    _refuse_late(campaign)
    write_atomically(folder / FILE, json.dumps(found.model_dump(mode="json"), indent=1) + "\n")
    return found


def _scenarios(campaign: Campaign) -> dict[str, RegisteredScenario]:
    found: dict[str, RegisteredScenario] = {}
    for cell in campaign.cells:
        key = scenario_key(cell.scenario, cell.placement)
        if key not in found:
            found[key] = _scenario(_experiment(campaign, cell), campaign.inside(cell).scenario)
    return found


def _experiment(campaign: Campaign, cell: Cell) -> Experiment:
    kind: CellKind = load_kind(campaign.kind(cell))
    experiment = read_experiment(campaign, cell)
    if not isinstance(experiment, Experiment):
        raise RegistrationError(
            f"{cell.name}: expected a cell of an experiment file, got one of {type(kind).__name__}, which cannot be registered"
        )
    experiment.ask_world()
    return experiment


def _scenario(experiment: Experiment, name: str) -> RegisteredScenario:
    config, limits = experiment.config, experiment.limits
    starts = [(float(x), float(y), float(yaw)) for x, y, yaw in experiment.measured_starts(name).tolist()]
    deployed = 0 if config.deploy.through == "nothing" else len(starts[: config.deploy.starts])
    return RegisteredScenario(
        settings_sha256=hash_of(registered_settings(experiment)),
        path=experiment.paths[name].to_dict(),
        ticks=limits.ticks,
        dt_s=limits.dt_s,
        off_track_m=limits.off_track_m,
        held_cap_m=limits.held_cap_m,
        starts=tuple(starts),
        deployed_starts=deployed,
        evaluations=planned_evaluations(experiment),
        space=config.space.model_dump(mode="json"),
        victims=config.policy.key(),
        drives_well_mean_cte_m=mean_cte_limit_m(limits.off_track_m),
    )


def _primary(cells: Sequence[Cell]) -> list[PrimaryTest]:
    """The gradient against all other methods, per scenario, on the hardened victim."""
    tests = []
    for scenario, placement in dict.fromkeys((cell.scenario, cell.placement) for cell in cells):
        methods = dict.fromkeys(
            cell.method
            for cell in cells
            if (cell.scenario, cell.placement, cell.victim) == (scenario, placement, HARDENED)
        )
        against = tuple(method for method in methods if method not in (*CONTROLS, _CLAIMED))
        if _CLAIMED in methods and against:
            tests.append(
                PrimaryTest(
                    scenario=scenario, placement=placement, victim=HARDENED, method=_CLAIMED, against=against
                )
            )
    return tests


def _refuse_late(campaign: Campaign) -> None:
    done = [
        each.cell.name
        for each in statuses(campaign, campaign.cells)
        if each.state in (*FINISHED, "begun", "running")
    ]
    if done:
        raise RegistrationError(
            f"expected to register before anything is run, got {len(done)} cells that are there or begun, such as {done[0]}; "
            "name another run folder, or other seeds"
        )
