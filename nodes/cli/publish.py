"""The command ``advnerf experiment publish``: finished cells, and what they were run with, go to where they are kept with the code."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.cli.cell_choice import CellChoice, load_cells
from nodes.runtime.terminal import say_error

if TYPE_CHECKING:
    from nodes.experiment.run.published import PublishedBuild


def publish(
    choice: CellChoice,
    to: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Folder of all published sets; gets a folder with the experiment's name.",
        ),
    ] = Path("docs/results"),
    prune: Annotated[
        bool, typer.Option("--prune", help="Remove cells there that other settings have made.")
    ] = False,
    build: Annotated[
        bool,
        typer.Option(
            "--build/--no-build",
            help="Keep the scenes and victims too, some 20 MB for each place; of a victim that is code, its digest alone.",
        ),
    ] = True,
    withdraw: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=REASON",
            help="Give a registered path or variant up of which nothing was published; the page says so, and why.",
        ),
    ] = None,
    declare: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME.VICTIM=REASON",
            help="Say that a victim breaks the registered rule of what drives well, and why it is shown; the page says so.",
        ),
    ] = None,
) -> None:
    """Copy the finished cells, and the scenes, victims and objects that they were run with, to where they are kept with the code."""
    from advnerf_core.policies.load import is_code
    from advnerf_core.report.evidence import registration
    from advnerf_core.report.evidence.above import write_above_of
    from advnerf_core.report.evidence.kept_build import LOST, is_kept
    from advnerf_core.report.evidence.publishing import write_numbers, write_page
    from advnerf_core.report.evidence.registration import SetError
    from advnerf_core.report.evidence.verify import verify_set
    from advnerf_core.report.evidence.verifying import victims
    from advnerf_core.report.evidence.verifying.digests import write_beside
    from nodes.experiment.run.plan import statuses
    from nodes.experiment.run.published import publish as copy_cells
    from nodes.experiment.run.published import publish_build
    from nodes.experiment.run.set_film import write_film
    from nodes.experiment.run.store import NOT_DRIVEN
    from nodes.experiment.show.given import given_in
    from nodes.runtime.config import key_and_value
    from nodes.runtime.errors import ConfigError

    experiment, cells = load_cells(choice)
    registered = (to / experiment.config.name / registration.FILE).exists()
    if registered and not build:
        raise ConfigError(
            f"expected to publish the registered set {experiment.config.name} with its scene and victim, got --no-build; leave it out: without them nobody "
            "can drive the set again"
        )
    found_here = statuses(experiment, cells)
    # Before anything is written: what cannot be published leaves the folder as it was.
    finished = {
        each.cell.name: each.result.registration
        for each in found_here
        if each.state == "done" and each.result
    }
    if registered:
        registration.require_registered(to / experiment.config.name, finished)
    if withdraw:
        registration.withdraw(
            to / experiment.config.name,
            dict(key_and_value("--withdraw", each, "left=REASON", "NAME=REASON") for each in withdraw),
            finished,
        )
    if declare:
        reasons = dict(
            key_and_value("--declare", each, "left.own=REASON", "NAME.VICTIM=REASON") for each in declare
        )
        victims.declare(to / experiment.config.name, reasons)
    for each in found_here:
        if each.state == NOT_DRIVEN:
            say_error(
                f"{each.cell.name} is no evidence and is not published: it was not driven live: {each.text}"
            )
    found = copy_cells(experiment, found_here, to, prune)
    for name in found.written:
        print(f"{to / experiment.config.name / name}.json")
    if build:  # before the page, which says whether the set can be driven again
        _say_build(publish_build(experiment, cells, to, prune))
        if registered and not is_kept(to / experiment.config.name):
            code = [name for name, spec in given_in(experiment.config).items() if is_code(spec)]
            why = (
                f": {', '.join(code)} is code or a driver, of which the digest alone is kept" if code else ""
            )
            say_error(f"{experiment.config.name} {LOST}{why}")
    part = verify_set(to / experiment.config.name) if registered else None
    if part is not None and not part.awaits:
        print(write_numbers(to / experiment.config.name))
        if (film := write_film(experiment, to / experiment.config.name)) is not None:
            print(film)
            print(write_above_of(to / experiment.config.name))  # with frames of the film
        print(write_page(to))
    else:
        if part is not None and part.problems:
            raise SetError(f"{to / part.name}: cannot be published: {part.problems[0]}")
        if part is not None:
            print(f"{to / part.name}: its numbers are published when {part.awaits} more cells are there")
        else:
            print(
                f"{experiment.config.name} is not registered, so its cells are no evidence and have no page here; register an experiment before it "
                "is run, see advnerf experiment register"
            )
        write_beside(to)
    unfinished = len(cells) - len(found.written) - len(found.same)
    print(f"{len(found.written)} cells written, {len(found.same)} were there, {unfinished} are not finished")
    if found.stale:
        what = "were made with other settings and " + (
            "are removed" if prune else "stay, until --prune removes them"
        )
        print(f"{len(found.stale)} of those there {what}: {', '.join(found.stale)}")


def _say_build(build: PublishedBuild) -> None:
    for each in build.written:
        print(each)
    for each in build.removed:
        print(f"{each}: removed, as no published cell was run with it")
    print(f"{build.folder}: {build.size_bytes / 1e6:.1f} MB")
