"""The command ``advnerf scene gate``, which tests whether a surrogate is good enough for attacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from nodes.cli.cell_choice import File, Folder, Setting
from nodes.runtime.terminal import Overrides, coloured, fail_unless, print_table, table


def gate(
    file: File,
    setting: Setting = None,
    run_folder: Folder = None,
    path: Annotated[
        str,
        typer.Option(help="Path of the experiment; none: the first. The views that are compared are of all."),
    ] = "",
    victim: Annotated[
        str, typer.Option(help="Victim of the experiment, by its name; none: the main one.")
    ] = "",
    bag: Annotated[
        Path | None, typer.Option(help="Bag of a drive without an attack, to compare as well.", exists=True)
    ] = None,
    psnr_db: Annotated[
        float | None,
        typer.Option("--psnr", help="Lowest accepted mean PSNR at the policy's image size [dB]."),
    ] = None,
    ssim: Annotated[
        float | None, typer.Option(help="Lowest accepted mean SSIM at the policy's image size.")
    ] = None,
    steering: Annotated[
        float | None, typer.Option(help="Largest accepted mean steering difference [rad or rad/s].")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
    overrides: Overrides = None,
) -> None:
    """Compare learned with real views by image quality and by the policy's steering. Exit code 1 if the surrogate fails."""
    from advnerf_core.plugins import unknown
    from advnerf_core.report.conditions import NONE
    from advnerf_core.scene.gate_limits import GateLimits
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.run.gate import judge_scene
    from nodes.experiment.steps.run import load_experiment
    from nodes.runtime.errors import ConfigError

    experiment = load_experiment(file, setting, overrides or [], run_folder)
    experiment.require_one()
    config = experiment.config
    path, victim = path or config.paths[0], victim or config.main_victim
    for what, name, names in (("path", path, config.paths), ("victim", victim, config.all_victims)):
        if name not in names:
            raise ConfigError(f"{file}: --{what}: {unknown(name, what, names)}")
    wanted = {"psnr_db": psnr_db, "ssim": ssim, "steering": steering}
    limits = GateLimits.model_validate({name: value for name, value in wanted.items() if value is not None})
    verdicts = judge_scene(experiment, Cell(path, victim, NONE, 0), limits, bag)
    if as_json:
        print(json.dumps({of: verdict.record() for of, verdict in verdicts}))
    else:
        rows = table(
            "pictures", "views", "PSNR [dB]", "SSIM", "steering difference", "worst", "correlation", "verdict"
        )
        for of, verdict in verdicts:
            n = verdict.numbers
            rows.add_row(
                of,
                str(n["views"]),
                f"{n['psnr_db']:.2f}",
                f"{n['ssim']:.3f}",
                f"{n['steering']:.4f}",
                f"{n['steering_worst']:.4f}",
                f"{n['correlation']:.4f}",
                coloured("pass", "green") if verdict.passed else coloured("refused", "red"),
            )
        print_table(rows)
        for reason in [reason for _, verdict in verdicts for reason in verdict.reasons]:
            print(reason)
    fail_unless(all(verdict.passed for _, verdict in verdicts))
