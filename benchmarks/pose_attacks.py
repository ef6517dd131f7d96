"""Question: do places and colours together beat a retrained policy, where random ones do not? ``python -m benchmarks.pose_attacks RUN_FOLDER``.

The victim is the one that stage retrain made in its first round (``--set retrain.placements=...``: from colour attacks and random places). Each drive, method and
seed is one cell, kept in ``RUN_FOLDER/poses`` when it is finished. Ratios are of total CTE to the plain objects where they were placed by hand.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.driving.policy import load_policy
from benchmarks.results import record_row
from hardware.twin.intersection.scene import Intersection
from nodes.intersection.context import Experiment
from nodes.intersection.poses import PoseMethod, pose_cell
from nodes.intersection.retrain import retrained_file
from nodes.intersection.run import experiment_of

_SEEDS = 3  # fewer are told, and judged by nobody
_METHODS: tuple[PoseMethod, ...] = ("random", "gradient")


def cells_of(
    experiment: Experiment, scenarios: list[str], methods: list[PoseMethod], seeds: list[int], folder: Path
) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Cells by drive and method; what is there is not searched again."""
    victim = load_policy(retrained_file(experiment))
    cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    with Intersection(experiment.world) as scene:
        for scenario in scenarios:
            for method in methods:

                def told(fraction: float, text: str = "", scenario: str = scenario) -> None:
                    print(f"\r{scenario} {text}  ", end="", flush=True)

                cells[scenario, method] = [
                    pose_cell(experiment, victim, scenario, method, seed, folder, told, scene) for seed in seeds
                ]
    return cells


def total_m(cells: list[dict[str, Any]], domain: str, which: str = "total_cte_m") -> float:
    """Mean total CTE of cells in a domain [m]."""
    return float(np.mean([np.mean(cell[domain][which]) for cell in cells]))


def spread_of(cells: list[dict[str, Any]]) -> str:
    """Deployed total CTE of each seed, in words."""
    return f"{len(cells)} seed(s): " + ", ".join(f"{np.mean(cell['deployed']['total_cte_m']):.1f} m" for cell in cells)


def main() -> None:
    """Search, drive, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the intersection's experiment")
    parser.add_argument("--scenarios", nargs="+", help="drives; all if not given")
    parser.add_argument("--methods", nargs="+", choices=_METHODS, default=list(_METHODS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    options = parser.parse_args()
    experiment = experiment_of(options.folder)
    scenarios = options.scenarios or list(experiment.config.scenarios)
    cells = cells_of(experiment, scenarios, options.methods, options.seeds, options.folder / "poses")
    command = f"python -m benchmarks.pose_attacks {options.folder} --seeds {' '.join(map(str, options.seeds))}"
    for scenario in scenarios:
        totals = {m: {d: total_m(cells[scenario, m], d) for d in ("surrogate", "deployed")} for m in options.methods}
        bases = {
            d: total_m(cells[scenario, options.methods[0]], d, "none_total_cte_m") for d in ("surrogate", "deployed")
        }
        ratios = {m: {d: totals[m][d] / bases[d] for d in bases} for m in totals}
        for method, by_domain in ratios.items():
            note = f"learned scene {by_domain['surrogate']:.2f} x of {bases['surrogate']:.2f} m; deployed base {bases['deployed']:.2f} m; {spread_of(cells[scenario, method])}"
            line, met, target = f"#5 places and colours, retrained policy, {scenario}, {method}, deployed", None, ""
            if method == "gradient" and "random" in ratios:
                against = ratios["random"]["deployed"]
                target = f"> {against:.2f} x (random)"
                met = by_domain["deployed"] > against if len(options.seeds) >= _SEEDS else None
            print(f"\n{line}: {by_domain['deployed']:.2f} x (target {target or '-'}): {met}; {note}")
            if not options.trial:
                record_row(line, by_domain["deployed"], "x no attack", target, met, command, note)


if __name__ == "__main__":
    main()
