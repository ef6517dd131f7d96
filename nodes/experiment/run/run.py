"""Runs cells: prepares their inputs, then runs them, over cores or over a cluster; current results are not repeated."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import groupby
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from nodes.experiment.plan.cell import SEARCHED_SHARE, Cell
from nodes.experiment.plan.rules import check_options
from nodes.experiment.run.admission import past_the_gate
from nodes.experiment.run.cells import Bench, needed_settings
from nodes.experiment.run.plan import elsewhere, not_registered, plan_cells
from nodes.experiment.run.store import NOT_DRIVEN, Store
from nodes.experiment.run.worker import Ended, Job, Phase, run_here, run_in_process, wait_for_live
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.keys import require_searchable
from nodes.experiment.steps.run import prepare_victims
from nodes.experiment.steps.steering_gate import require_same_steering
from nodes.lab.trials.tries import allow_more_tries
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay, Report, StageDisplay

Backend = Literal["local", "ray"]
Say = Callable[[str], None]
# How often cells are resubmitted after a whole machine of a cluster was lost.
_ROUNDS = 3


@dataclass(frozen=True)
class Options:
    """Options for running cells.

    Attributes:
        jobs: Number of parallel cells; 0 uses one per core, or the cores of the cluster.
        threads: Threads per cell; 0 shares the cores among the jobs.
        backend: ``local`` or ``ray``.
        address: Address of a running Ray cluster; empty uses RAY_ADDRESS, or starts one here.
        retry: Also run cells that failed before.
        gate: Whether cells whose surrogate fails the fidelity gate are left out; else there is only a warning.
        search_only: Search without deployment: for predictions before the drives, or to choose what to deploy.
        here: Run one cell after another in this process, which starts no others and shares resources among cells of one experiment.
        ready: Whether the inputs of the cells exist already.
    """

    jobs: int = 0
    threads: int = 0
    backend: Backend = "local"
    address: str = ""
    retry: bool = False
    gate: bool = True
    search_only: bool = False
    here: bool = False
    ready: bool = False


def run_cells(
    experiment: Experiment,
    cells: Sequence[Cell],
    options: Options,
    say: Say,
    console: Console | None = None,
    watcher: StageDisplay | None = None,
) -> list[Ended]:
    """Run the cells that are not finished yet; returns how each of them ended, in the order of their ends.

    Args:
        say: Called with a message for every start and end.
        console: Console for the progress of cells in this process.
        watcher: Also receives that progress.

    Raises:
        ConfigError: A variant is wrong; nothing was run.
    """
    store = Store(experiment.folder)
    if not options.ready:
        _prepare(experiment, cells, options, say)
    # Before the gate, so that an impossible cell is reported first.
    plan = plan_cells(experiment, cells)
    judged = past_the_gate(experiment, cells, options.gate, say)
    wanted = [
        each
        for each in plan
        if each.cell in judged and _is_wanted(store, each, elsewhere(experiment, each.cell), options, say)
    ]
    if not wanted:
        there = sum(
            store.status(each.cell, each.settings_hash, elsewhere(experiment, each.cell)).state == "done"
            for each in plan
        )
        say(
            f"nothing to do: {'every cell is' if there == len(plan) else f'{there} of {len(plan)} cells are'} there"
        )
        return []
    if text := not_registered(experiment, [each.cell for each in wanted]):
        say(text)
    if options.here:
        return _run_here(store, wanted, experiment, options, say, ProgressDisplay(console, watcher))
    jobs, threads = _shares(options)
    if options.search_only:
        say(f"{len(wanted)} cells to search, {_at_a_time(jobs, threads)}")
        return _run_beside(
            [replace(each, threads=threads, phase="search") for each in wanted], jobs, options, say
        )
    say(f"{len(wanted)} of {len(cells)} cells to run, {_at_a_time(jobs, threads)}")
    beside = [replace(each, threads=threads) for each in wanted if not each.alone]
    beside += [replace(each, threads=threads, phase="search") for each in wanted if each.alone]
    ended = _run_beside(beside, jobs, options, say)
    lost = {end.name for end in ended if end.how != "done"}
    searched = {job.name for job in beside if job.phase == "search"}
    ended = [end for end in ended if end.name not in searched or end.how != "done"]
    # The live graphs have the machine to themselves, one after the other; they share their nodes.
    alone = [each for each in wanted if each.alone and each.cell.name not in lost]
    ended += _run_here(
        store, alone, experiment, options, say, ProgressDisplay(console, watcher), searched=True
    )
    # Their drives without attack exist now.
    past_the_gate(experiment, [each.cell for each in wanted if each.alone], options.gate, say)
    return ended


def _run_here(
    store: Store,
    wanted: Sequence[Job],
    experiment: Experiment,
    options: Options,
    say: Say,
    display: ProgressDisplay,
    searched: bool = False,
) -> list[Ended]:
    """Run one cell after another in this process; cells of one variant share its resources."""
    ended: list[Ended] = []
    for _, group in groupby(wanted, lambda each: each.cell.variant):
        cells = list(group)
        variant = experiment.of(cells[0].cell)
        with display, Bench(variant) as bench:
            ended += _run_on(variant, bench, store, cells, options, display, searched)
    for end in ended:
        if end.how != "done" or end.text:
            say(f"{end.name}: {end.how}: {end.text}")
    return ended


def _run_on(
    variant: Experiment,
    bench: Bench,
    store: Store,
    cells: Sequence[Job],
    options: Options,
    display: ProgressDisplay,
    searched: bool,
) -> list[Ended]:
    """Run the cells of one variant. Those with live drives are all searched first, as nodes that wait take time from searches."""
    reports: dict[str, Report] = {}
    seconds: dict[str, float] = {}

    def run(each: Job, phase: Phase, last: bool = True) -> Ended:
        name = each.cell.name
        if name not in reports:
            reports[name] = display.start(name)
        job = replace(each, threads=_cores(), phase=phase)
        end = run_here(job, store, variant, bench, reports[name])
        seconds[name] = seconds.get(name, 0.0) + end.seconds
        if end.how == "done" and last:
            display.finish(name, seconds[name], cached=False)
        elif end.how == "done":
            reports[name](SEARCHED_SHARE, "searched")
        return end

    if options.search_only:
        return [run(each, "search") for each in cells]
    first = [] if searched else [each for each in cells if each.alone]
    lost = {each.cell.name: end for each in first if (end := run(each, "search", last=False)).how != "done"}
    left = [each for each in cells if each.cell.name not in lost]
    with wait_for_live() if any(each.alone for each in left) else nullcontext():
        return [*lost.values(), *(run(each, "whole") for each in left)]


def _at_a_time(jobs: int, threads: int) -> str:
    return f"{jobs or 'all the cluster has cores for'} at a time, {threads} threads each"


def _prepare(experiment: Experiment, cells: Sequence[Cell], options: Options, say: Say) -> None:
    # All variants are read before anything is made, so that a mistake in the last does not cost the hours of the first.
    wanted = {cell.variant: experiment.of(cell) for cell in cells}
    for each in wanted.values():
        look_at_given(each)
    require_searchable(experiment, cells)
    for each in wanted.values():
        check_options(each.config.methods, each.config.attack)
    for variant in one_of_each_folder(experiment, cells, say):
        prepare_victims(variant)
        require_same_steering(variant, not options.gate, say)


def one_of_each_folder(experiment: Experiment, cells: Sequence[Cell], say: Say) -> Iterator[Experiment]:
    """The first variant of each run folder of the cells, whose stages are those of all in it; it is told which.

    Raises:
        ConfigError: A variant is wrong, or two in one folder need other stages; before the first one.
    """
    wanted = {cell.variant: experiment.of(cell) for cell in cells}
    _refuse_two_in_one_folder(experiment, cells)
    for name, variant in {each.folder: (name, each) for name, each in reversed(wanted.items())}.values():
        say(f"{name or variant.config.name}: {variant.folder}")
        yield variant


def _refuse_two_in_one_folder(experiment: Experiment, cells: Sequence[Cell]) -> None:
    """Variants in one run folder must need the same scene and policies, or each would use, or remake, the others'."""
    folders = {experiment.folder_of(cell) for cell in cells}
    first: dict[Path, tuple[str, dict[str, Any]]] = {}
    for cell in {each.variant: each for each in experiment.cells}.values():
        if (folder := experiment.folder_of(cell)) not in folders:
            continue
        needed = needed_settings(experiment.of(cell))
        name, others = first.setdefault(folder, (cell.variant, needed))
        if wrong := [stage for stage in needed.keys() & others.keys() if needed[stage] != others[stage]]:
            raise ConfigError(
                f"{experiment.file}: expected variants {name} and {cell.variant} to have the same settings of stage {', '.join(sorted(wrong))}, "
                f"as both are in {folder}, got different ones; give one of them a run_folder of its own"
            )


def _is_wanted(store: Store, each: Job, elsewhere: Sequence[Path], options: Options, say: Say) -> bool:
    status = store.status(each.cell, each.settings_hash, elsewhere)
    if status.state == NOT_DRIVEN:
        if options.retry:
            _allow_more_tries(store, each.cell.name)
        else:
            say(f"{each.cell.name}: not driven live, not tried again without --retry: {status.text}")
        return options.retry
    if status.state == "failed" and not options.retry:
        say(f"{each.cell.name}: failed before, not run again without --retry: {status.text}")
        return False
    if status.state == "running":
        say(f"{each.cell.name}: another process runs it")
        return False
    return status.state != "done"


def _allow_more_tries(store: Store, name: str) -> None:
    """Allow three more tries of a cell's drives, and of the drives without attack for comparison."""
    work = store.work(name)
    for folder in (work, *(work.parent / "shared").glob("*")):
        allow_more_tries(folder)


def _run_beside(jobs: list[Job], at_a_time: int, options: Options, say: Say) -> list[Ended]:
    if not jobs:
        return []
    if options.backend == "ray":
        return _run_on_ray(jobs, at_a_time, options, say)
    # Its threads are daemons: they do not keep a stopped run from ending, and their cells end with it.
    with ThreadPool(at_a_time) as pool:
        return [_tell(end, say) for end in pool.imap_unordered(run_in_process, jobs)]


def _run_on_ray(jobs: list[Job], at_a_time: int, options: Options, say: Say) -> list[Ended]:
    from nodes.experiment.run.cluster import ray_session, run_on_ray

    with ray_session(options.address, at_a_time or _cores()) as cores:
        say(f"Ray cluster with {cores} cores; advnerf experiment status tells how far it is")
        at_a_time = at_a_time or max(1, cores // (options.threads or 1))
        ended: list[Ended] = []
        left = jobs
        for _ in range(_ROUNDS):
            lost = []
            for job, end in run_on_ray(run_in_process, left, min(at_a_time, cores)):
                if end is None and _is_finished(job):
                    end = Ended(job.name, "done", "", 0.0)
                if end is None:
                    lost.append(job)
                else:
                    ended.append(_tell(end, say))
            if not lost:
                return ended
            say(f"a machine of the cluster was lost: {len(lost)} cells are handed out again")
            left = lost
        text = "its machine was lost again and again; it goes on when the experiment is run again"
        return ended + [_tell(Ended(job.name, "lost", text, 0.0), say) for job in left]


def _is_finished(job: Job) -> bool:
    """Whether a result with these settings exists, even without its message; a search has no result and resumes from its state."""
    result = Store(Path(job.folder)).result(job.name)
    return result is not None and result.settings_hash == job.settings_hash


def _tell(end: Ended, say: Say) -> Ended:
    say(f"{end.name}: {end.how} after {end.seconds:.1f} s{': ' * bool(end.text)}{end.text}")
    return end


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _shares(options: Options) -> tuple[int, int]:
    """Number of parallel cells, 0 for the cores of a cluster, which only the cluster knows; and threads of each."""
    if options.backend == "ray":
        return options.jobs, options.threads or 1
    jobs = options.jobs or (_cores() // options.threads if options.threads else _cores()) or 1
    return jobs, options.threads or max(1, _cores() // jobs)
