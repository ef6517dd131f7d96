"""Runs a whole experiment: its stages, its cells (here, over cores or over a cluster), its report. Called by ``advnerf experiment run``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from rich.console import Console

from advnerf_core.files import sha256_of
from advnerf_core.plugins import name_in_results
from advnerf_core.report.conditions import CONTROLS, NONE
from nodes.experiment.engine.artefact import Settings
from nodes.experiment.engine.progress_record import ProgressRecord
from nodes.experiment.engine.run_folder import require_own_folder
from nodes.experiment.engine.stages import Stage, check_until, run_stages
from nodes.experiment.pages import report
from nodes.experiment.plan.cell import Cell, select
from nodes.experiment.plan.rules import check_options
from nodes.experiment.run.plan import statuses
from nodes.experiment.run.run import Options, Say, one_of_each_folder, run_cells
from nodes.experiment.run.store import FINISHED, NOT_DRIVEN
from nodes.experiment.run.worker import Ended
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.keys import require_searchable
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import make_ready
from nodes.experiment.steps.steering_gate import require_same_steering
from nodes.runtime.console import plain_console
from nodes.runtime.progress import ProgressDisplay

REPORT = "report"


def run_experiment(
    experiment: Experiment,
    until: str | None = None,
    options: Options | None = None,
    only: str = "",
    console: Console | None = None,
    anew: bool = False,
    record: ProgressRecord | None = None,
) -> list[Ended]:
    """Run the unfinished stages and cells, and the report, which leaves out methods with a failed cell; returns how every cell that was run ended.

    Args:
        until: Last stage to run; None for all, and the cells.
        options: Options for running cells; None runs one after another in this process.
        only: Selection of cells, see `select`.
        anew: Whether to make stages here that are stored with the code.
        record: Progress record for the experiment page.

    Raises:
        StageError: ``until`` names no stage.
        ConfigError: The folder has the stages of another experiment, or ``only`` matches no cell.
    """
    console, began = console or plain_console(), time.monotonic()
    require_own_folder(experiment)
    look_at_given(experiment)
    stages = [*stages_of(experiment), _report_stage(experiment, {})]
    check_until(stages, until)
    chosen = select(experiment.cells, only)
    if until in (None, REPORT):
        require_searchable(experiment, chosen)
        check_options(experiment.config.methods, experiment.config.attack)
    if record is not None:
        names = [stage.name for stage in stages]
        until_there = names if until is None else names[: names.index(until) + 1]
        record.plan(until_there, chosen if REPORT in until_there else [])
    make_ready(experiment, None if until == REPORT else until, console, anew, record)
    ended: list[Ended] = []
    if until in (None, REPORT):
        options = options or Options(here=True, ready=True)
        say = partial(_say, console, record)
        require_same_steering(experiment, not options.gate, say)
        if record is not None:
            _record_cells_there(experiment, chosen, options, record)
        ended = run_cells(experiment, chosen, options, say, console, record)
        _write_report(experiment, console, record)
    console.print(
        f"{experiment.config.name}{experiment.setting and f' ({experiment.setting})'}: {time.monotonic() - began:.0f} s",
        highlight=False,
        markup=False,
    )
    return ended


def run_stages_of_variants(
    experiment: Experiment, cells: Sequence[Cell], until: str, say: Say, anew: bool = False
) -> None:
    """Run the unfinished stages of each run folder of an experiment with variants, up to one.

    Raises:
        StageError: ``until`` names no stage; nothing was run.
        ConfigError: A variant is wrong, or two in one folder need other stages; nothing was run.
    """
    for variant in {cell.variant: experiment.of(cell) for cell in cells}.values():
        look_at_given(variant)
        check_until(stages_of(variant), until)
    for variant in one_of_each_folder(experiment, cells, say):
        make_ready(variant, until, anew=anew)


def _say(console: Console, record: ProgressRecord | None, text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
    if record is not None:
        record.say(text)


def _record_cells_there(
    experiment: Experiment, chosen: Sequence[Cell], options: Options, record: ProgressRecord
) -> None:
    """Record the cells that will not be run again: finished, or failed before."""
    for each in statuses(experiment, chosen):
        if each.state in FINISHED and not (each.state == NOT_DRIVEN and options.retry):
            record.finish(each.cell.name, 0.0, cached=True)
        elif each.state == "failed" and not options.retry:
            record.fail(each.cell.name, each.text)


def _write_report(experiment: Experiment, console: Console, record: ProgressRecord | None) -> None:
    """The report of the methods whose cells are all finished and deployed, once no cell is left to run.

    A method with a failed cell is left out and named. The report's inputs are part of its key.
    """
    found = statuses(experiment, experiment.cells)
    failed = {each.cell.method: f"{each.cell.name}: {each.text}" for each in found if each.state == "failed"}
    reported = _of_methods(
        experiment, [name for name in experiment.config.method_names if name not in failed]
    )
    done = {each.cell.name for each in found if each.state in FINISHED}
    files = {cell.name: experiment.cell_result(cell) for cell in reported.cells}
    missing = [name for name, file in files.items() if name not in done or not file.exists()]
    notes = [f"not in the report, as a cell failed: {name} ({text})" for name, text in failed.items()]
    lacking = ""
    if NONE not in reported.config.over.method:
        lacking = "no report: it compares with drives without attack, and over.method has no none; add it"
    elif not experiment.config.methods:
        lacking = "no report: over.method has no attack that could be compared; add one"
    elif missing or not reported.config.methods:
        lacking = f"no report yet: {len(found) - len(done)} of {len(found)} cells are missing"
    for text in [lacking] if lacking else notes:
        _say(console, record, text)
    if lacking:
        return
    digests = {name: sha256_of(file) for name, file in files.items()}
    with ProgressDisplay(console, record) as display:
        run_stages([_report_stage(reported, digests, notes)], experiment.folder, display)
    report.print_summary(reported, console)


def _of_methods(experiment: Experiment, names: Sequence[str]) -> Experiment:
    """The same experiment with some of its methods."""
    config = experiment.config
    kept = tuple(each for each in config.over.method if each in CONTROLS or name_in_results(each) in names)
    if kept == config.over.method:
        return experiment
    over = config.over.model_copy(update={"method": kept})
    return replace(experiment, config=config.model_copy(update={"over": over}))


def _report_stage(experiment: Experiment, digests: dict[str, str], notes: Sequence[str] = ()) -> Stage:
    held_to = experiment.held_to.model_dump(mode="json")
    settings = Settings.of(cells=digests, setting=experiment.setting, held_to=held_to, notes=list(notes))
    return Stage(REPORT, lambda folder, told: report.run(experiment, folder, told, notes), settings)
