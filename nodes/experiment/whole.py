"""Runs a whole experiment: its stages, its cells (here, over cores or over a cluster), its report. Called by ``advnerf experiment``."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence

from rich.console import Console

from nodes.experiment import report
from nodes.experiment.attack import cells
from nodes.experiment.campaign.config import Campaign, campaign_of
from nodes.experiment.campaign.plan import statuses
from nodes.experiment.campaign.run import Options, run_campaign
from nodes.experiment.campaign.store import FINISHED, NOT_DRIVEN
from nodes.experiment.campaign.worker import Ended
from nodes.experiment.cell import Cell, select
from nodes.experiment.context import Experiment
from nodes.experiment.progress_record import ProgressRecord
from nodes.experiment.run import make_ready, stages_of
from nodes.experiment.run_folder import require_own_folder
from nodes.experiment.stage_record import Stage
from nodes.experiment.stages import check_until, run_stages
from nodes.runtime.progress import ProgressDisplay

REPORT = "report"


def run_experiment(
    experiment: Experiment,
    until: str | None = None,
    options: Options | None = None,
    only: str = "",
    overrides: Sequence[str] = (),
    console: Console | None = None,
    anew: bool = False,
    record: ProgressRecord | None = None,
) -> list[Ended]:
    """Run the stages and the cells that are not there yet; where all cells are there, also the report.

    Args:
        experiment: The experiment.
        until: Last stage to run; None for all, and the cells.
        options: How cells are run; None runs one after another in this process.
        only: Which cells; see `select`.
        overrides: ``key=value`` texts with which the experiment was read, for other processes.
        console: Where to print.
        anew: Whether stages are made here that are kept with the code.
        record: Keeps the progress for the experiment page.

    Returns:
        How every cell that was run ended.

    Raises:
        StageError: ``until`` names no stage.
        ConfigError: The folder has the stages of another experiment, or ``only`` fits no cell.
    """
    console, began = console or Console(), time.monotonic()
    stages = [*stages_of(experiment), _report_stage(experiment, {})]
    check_until(stages, until)
    plan = cells(experiment)
    chosen = select(plan, only)
    if record is not None:
        require_own_folder(experiment)
        names = [stage.name for stage in stages]
        until_there = names if until is None else names[: names.index(until) + 1]
        record.plan(until_there, chosen if REPORT in until_there else [])
    make_ready(experiment, None if until == REPORT else until, console, anew, record)
    ended: list[Ended] = []
    if until in (None, REPORT):
        campaign = campaign_of(experiment, overrides, plan)
        options = options or Options(here=True, ready=True)
        ended = _run_cells(experiment, campaign, chosen, options, console, record)
        _write_report(experiment, campaign, console, record)
    console.print(
        f"{experiment.config.name} ({experiment.setting}): {time.monotonic() - began:.0f} s", highlight=False
    )
    return ended


def _run_cells(
    experiment: Experiment,
    campaign: Campaign,
    chosen: Sequence[Cell],
    options: Options,
    console: Console,
    record: ProgressRecord | None,
) -> list[Ended]:
    known = {(name, ""): experiment for name in campaign.scenarios}
    if record is not None:
        _record_cells_there(campaign, chosen, options, record)

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)
        if record is not None:
            record.say(text)

    return run_campaign(campaign, chosen, options, say, known, console, record)


def _record_cells_there(
    campaign: Campaign, chosen: Sequence[Cell], options: Options, record: ProgressRecord
) -> None:
    """Cells that will not be run again: done, or failed before."""
    for each in statuses(campaign, chosen):
        if each.state in FINISHED and not (each.state == NOT_DRIVEN and options.retry):
            record.finish(each.cell.name, 0.0, cached=True)
        elif each.state == "failed" and not options.retry:
            record.fail(each.cell.name, each.text)


def _write_report(
    experiment: Experiment, campaign: Campaign, console: Console, record: ProgressRecord | None
) -> None:
    """The report, once every cell of these settings is here and deployed; what it was made of is part of its key."""
    files = {cell.name: experiment.cell_result(cell) for cell in campaign.cells}
    found = statuses(campaign, campaign.cells)
    missing = [
        each.cell.name for each in found if each.state not in FINISHED or not files[each.cell.name].exists()
    ]
    if experiment.config.deploy.through == "nothing":
        return
    if missing:
        text = f"no report yet: {len(missing)} of {len(found)} cells are missing"
        console.print(text, highlight=False)
        if record is not None:
            record.say(text)
        return
    digests = {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}
    with ProgressDisplay(console, record) as display:
        run_stages([_report_stage(experiment, digests)], experiment.folder, display)
    report.print_summary(experiment, console)


def _report_stage(experiment: Experiment, digests: dict[str, str]) -> Stage:
    held_to = experiment.held_to.model_dump(mode="json")
    settings = {"cells": digests, "setting": experiment.setting, "held_to": held_to}
    return Stage(REPORT, lambda folder, told: report.run(experiment, folder, told), settings)
