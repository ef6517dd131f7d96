"""Is the learned copy of a foreign road good enough, and does the victim drive well there? ``python -m benchmarks.learned_roads RUN_FOLDER...``.

Reads run folders of experiments in worlds of other people: held-out views of the driving camera at the policy's size, the policy's control on
true and learned views, and the deployed drives without attack of the hardened victim, judged by the limit that registrations fix. A road
of which there are photographs and a scene alone (``advnerf experiment run ... --until bake``) is looked at by the victim of another run folder,
with ``--victim-of``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import drives as drives_well
from advnerf_core.driving.metrics import mean_cte_limit_m
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.report.cells import read_cell
from benchmarks.results import record_row
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_spec
from nodes.experiment.steps.policy import agreement

_LEAST_DB, _MOST_SHARE, _MOST_MIN = 25.0, 0.02, 60.0


def main() -> None:
    """Record the rows of each run folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_folders", nargs="+", type=Path)
    parser.add_argument(
        "--cell", type=Path, help="cell without attack, of one run folder whose drives lie elsewhere"
    )
    parser.add_argument("--victim-of", type=Path, help="run folder with the victim, where there is none")
    parser.add_argument("--wall-s", type=float, help="what `make world` took, from the installation on [s]")
    arguments = parser.parse_args()
    if arguments.cell is not None and len(arguments.run_folders) > 1:
        parser.error("expected one run folder with --cell, got several")
    for folder in arguments.run_folders:
        experiment = Experiment.resolved_in(folder)
        record(experiment, arguments.cell, arguments.victim_of)
        if arguments.wall_s is not None:
            _record_time(experiment, arguments.wall_s / 60.0)


def _record_time(experiment: Experiment, minutes: float) -> None:
    """The row of `make world`."""
    world, measured = experiment.config.world, experiment.config.measure
    road = world.get("road", {})
    changes = " ".join(f"--set world.road.{key}={road[key]}" for key in ("blocks", "seed") if key in road)
    command = f"make world NAME={world['kind']}" + (f' CHANGES="{changes}"' if changes else "")
    note = f"{len(experiment.config.methods)} searches, {measured.starts} starts"
    record_row(
        f"{road_of(world)}: from its installation to its table, setting {experiment.setting}",
        minutes,
        "min",
        f"<= {_MOST_MIN:g} min",
        minutes <= _MOST_MIN,
        command,
        note,
    )


def record(experiment: Experiment, cell: Path | None = None, victim_of: Path | None = None) -> None:
    """The rows of one road: three, or without drives two."""
    folder, scene = experiment.folder, experiment.config.scene
    about = read_json(folder / "capture" / "world.json")["description"]
    name = road_of(experiment.config.world)
    command = f"python -m benchmarks.learned_roads {folder}{f' --cell {cell}' if cell else ''}{f' --victim-of {victim_of}' if victim_of else ''}"
    psnr_db = read_json(folder / "scene" / "fidelity.json")["mean"]["psnr_policy_db"]
    record_row(
        f"{name}: held-out driving views, 200x66",
        psnr_db,
        "dB",
        f">= {_LEAST_DB:g} dB",
        psnr_db >= _LEAST_DB,
        command,
        f"{scene.steps} steps, decay {scene.decay} from {scene.learning_rate:g}",
    )
    whose = ""
    if victim_of is None:
        views = read_json(folder / "policy" / "policy.json")["on_held_out_views"]
    else:
        other = Experiment.resolved_in(victim_of)
        victim, whose = (
            Path(victim_spec(other, HARDENED)),
            f"; by the victim of {road_of(other.config.world)}",
        )
        views = agreement(experiment, load_policy(victim).policy)
    right, left = about["car"]["control_limits"]
    share = float(np.mean([abs(view["real"] - view["surrogate"]) for view in views])) / (left - right)
    record_row(f"{name}: control on true and learned views, mean difference", 100.0 * share, "% of the range", f"<= {100 * _MOST_SHARE:g} %", share <= _MOST_SHARE, command, f"{len(views)} views{whose}")  # fmt: skip
    cell = cell or next(iter(sorted((folder / "cells").glob("*_hardened_none_0.json"))), None)
    drives = without_attack(cell)
    if drives:
        mean_m, off = float(np.mean([drive[0] for drive in drives])), sum(drive[1] for drive in drives)
        limit_m = mean_cte_limit_m(about["off_track_m"])
        well = drives_well(mean_m, off > 0, about["off_track_m"])
        record_row(f"{name}: hardened victim without attack, mean abs. CTE deployed", mean_m, "m", f"<= {limit_m:.2f} m, none off the track", well, command, f"{len(drives)} drives, {off} off the track, worst {max(drive[0] for drive in drives):.3f} m")  # fmt: skip
    print(
        f"{name}: {psnr_db:.1f} dB, control {100 * share:.2f} % of its range, {len(drives)} drives without attack"
    )


def road_of(world: dict[str, object]) -> str:
    """A world and its road in words."""
    road = world.get("road")
    where = (
        f"road {road['blocks']} of seed {road['seed']}"
        if isinstance(road, dict)
        else str(world.get("map_name", ""))
    )
    return f"{world['kind']}, {where}".rstrip(", ")


def without_attack(file: Path | None) -> list[tuple[float, bool]]:
    """Mean |CTE| [m] of each deployed drive of a cell, and whether it left the track."""
    cell = read_cell(file) if file is not None else None
    if cell is None or cell.deployed is None:
        return []
    return [
        (total_m / kept.driven_ticks, off)
        for total_m, off, kept in zip(
            cell.deployed.total_cte_m, cell.deployed.off_track, cell.kept["deployed"], strict=True
        )
    ]


if __name__ == "__main__":
    main()
