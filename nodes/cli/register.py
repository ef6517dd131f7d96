"""The command ``advnerf experiment register``: what will be run and claimed, written down before it is run."""

from __future__ import annotations

from pathlib import Path

from nodes.cli.cell_choice import CellChoice, load_cells


def register(choice: CellChoice) -> None:
    """Write down in docs/results what an experiment will run, and which tests will be claimed, before anything is run."""
    from advnerf_core.report.evidence.registration import FILE
    from nodes.experiment.engine.artefact import PUBLISHED as published
    from nodes.experiment.run.registering import register as write_registration
    from nodes.runtime.errors import ConfigError

    if not published.is_dir():  # cells are run under what is registered there, and nowhere else
        raise ConfigError(
            f"expected the folder of published sets, {published}, in the working folder {Path.cwd()}, found none; change to your checkout, or make it"
        )
    experiment, cells = load_cells(choice)
    was_there = (published / experiment.config.name / FILE).exists()
    found = write_registration(experiment, cells, published)
    what_next = f"registered before, on {found.date}" if was_there else "commit it, then run the experiment"
    print(f"{published / found.name / FILE}: {found.digest[:12]}")
    print(
        f"{len(found.cells)} cells, {len(found.scenarios)} paths and variants, {len(found.primary)} primary tests; {what_next}"
    )
    for name, scenario in found.scenarios.items():
        limit_m = scenario.drives_well_mean_cte_m
        print(
            f"{name}: a victim whose mean |CTE| without attack exceeds {limit_m:.3g} m, or that leaves the track, fails the set"
        )
