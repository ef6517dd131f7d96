"""Does a victim drive on roads that neither it nor anybody has seen? ``python -m benchmarks.unseen_roads RUN_FOLDER``.

The run folder is one of ``launch/metadrive.experiment.yaml --setting unseen`` (or of launch/gap_metadrive_unseen.experiment.yaml): its victim learned on ten roads of
MetaDrive's generator. It drives five others with MetaDrive's own car, from the measured starts, without any panel and past a plain one that
stands by the rule. On a road it drives well if it never leaves its lane and stays near its middle in the mean, by the limit that
registrations fix.
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from advnerf_core.driving.metrics import drives, mean_cte_limit_m
from advnerf_core.policies.network import Policy
from benchmarks.results import REPOSITORY, record_row
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed
from nodes.experiment.show.drives import deployed_drives
from nodes.experiment.show.native import stand_in
from nodes.experiment.show.objects import placed_objects
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.elsewhere import place_elsewhere
from nodes.experiment.steps.run import load_experiment

ROADS = (("CS", 201), ("SC", 202), ("CC", 203), ("CSC", 204), ("SCS", 205))
_FILE = REPOSITORY / "launch" / "metadrive.experiment.yaml"
_STARTS = 8


def main() -> None:
    """Drive all roads, and record one row each without and with a panel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_folder", type=Path)
    folder = parser.parse_args().run_folder
    experiment = load_experiment(_FILE, "unseen", [f"measure.starts={_STARTS}"], folder)
    policy = load_victim(experiment, HARDENED).policy
    well: dict[str, list[bool]] = {"no panel": [], "a plain panel": []}
    means: dict[str, list[float]] = {past: [] for past in well}
    for blocks, seed in ROADS:
        with ExitStack() as opened:
            there, world = place_elsewhere(experiment, (f"road.blocks={blocks}", f"road.seed={seed}"), opened)
            for past, objects in (("no panel", []), ("a plain panel", placed_objects(there))):
                mean_m, off = _drive(there, stand_in(there, world, objects, native=True), policy)
                means[past].append(mean_m)
                well[past].append(drives(mean_m, off > 0, there.limits.off_track_m))
                print(
                    f"{blocks} {seed}, past {past}: mean abs. CTE {mean_m:.3f} m, {off} of {_STARTS} drives off the lane",
                    flush=True,
                )
    limit_m = mean_cte_limit_m(experiment.limits.off_track_m)
    for past, each in well.items():
        note = f"mean abs. CTE {min(means[past]):.3f} to {max(means[past]):.3f} m, limit {limit_m:.2f} m; {_STARTS} drives of MetaDrive's own car on each"
        record_row(
            f"metadrive, five unseen roads: the victim drives well past {past}",
            sum(each),
            f"of {len(ROADS)}",
            f"{len(ROADS)}",
            all(each),
            f"python -m benchmarks.unseen_roads {folder}",
            note,
        )


def _drive(there: Experiment, dressed: Dressed, policy: Policy) -> tuple[float, int]:
    """Mean |CTE| over all drives [m], and how many left the lane."""
    (scenario,) = there.config.paths
    starts = there.measured_starts(scenario)
    found = deployed_drives(there, dressed, policy, scenario, starts, dressed.plain_theta())
    return float(np.mean([drive.metrics.mean_cte_m for drive in found])), sum(
        drive.metrics.off_track for drive in found
    )


if __name__ == "__main__":
    main()
