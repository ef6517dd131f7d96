"""Attacks on the meshes of the intersection, over its own frames, driven there: ``python -m benchmarks.mesh_attack RUN_FOLDER``.

The experiment's policies must be there (``advnerf experiment launch/intersection.experiment.yaml --until policy``). Each drive, seed and
method is one cell, kept in ``RUN_FOLDER/meshes`` when it is finished, so a table that was cut off goes on. Ratios are of total CTE to
the plain objects in the same scene, means over seeds and starts.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.mesh.shape import ShapeLimits
from benchmarks.results import record_row
from nodes.intersection.meshes import MeshMethod, MeshSettings, Target, mesh_cell
from nodes.intersection.run import experiment_of

_SEEDS = 3  # fewer are told, and judged by nobody
TARGETS = {
    ("texture", "straight"): 1.41,
    ("texture", "right"): 1.31,
    ("texture", "left"): 2.35,
    ("shape", "straight"): 10.0,
}


def ratio(cells: list[dict[str, Any]], where: str) -> tuple[float, float | None, float]:
    """Mean total CTE over that past plain objects, the spread of it over the cells, and what it is divided by [m]."""
    each = [float(np.mean(cell[where]["total_cte_m"])) for cell in cells]
    base = float(np.mean([np.mean(cell[where]["none_total_cte_m"]) for cell in cells]))
    return float(np.mean(each)) / base, float(np.std(each, ddof=1)) / base if len(each) > 1 else None, base


def main() -> None:
    """Search, drive, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the intersection's experiment")
    parser.add_argument("--target", choices=("texture", "shape"), default="texture")
    parser.add_argument("--scenarios", nargs="+", help="drives; all for textures, straight for shapes if not given")
    parser.add_argument("--victim", default="hardened")
    parser.add_argument("--methods", nargs="+", choices=("gradient", "random"), default=["gradient"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--texels", type=int, default=32)
    parser.add_argument("--bound", type=float, default=0.4, help="shapes: no vertex moves farther [m]")
    parser.add_argument("--ball", type=float, help="shapes: balls of this radius instead of cars and hydrants [m]")
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    options = parser.parse_args()
    experiment = experiment_of(options.folder)
    target: Target = options.target
    settings = MeshSettings(target, options.texels, options.ball, limits=ShapeLimits(bound_m=options.bound))
    scenarios = options.scenarios or (list(experiment.config.scenarios) if target == "texture" else ["straight"])
    command = "python -m benchmarks.mesh_attack " + " ".join(sys.argv[1:])
    target_name = target if target == "texture" else f"shape within {options.bound:g} m"
    objects = "" if options.ball is None else f", balls of {options.ball:g} m"
    of_victim = "" if options.victim == "hardened" else f", {options.victim} victim"
    folder = options.folder / "meshes" / f"{target}_{options.texels}_{options.bound}_{options.ball}"
    for scenario in scenarios:
        for method in options.methods:
            asked: MeshMethod = method
            cells = [
                mesh_cell(experiment, scenario, options.victim, asked, seed, folder, lambda f, text="": print(f"\r{text}  ", end=""), settings)
                for seed in options.seeds
            ]  # fmt: skip
            ideal, deployed = ratio(cells, "surrogate"), ratio(cells, "deployed")
            spread = "one seed" if deployed[1] is None else f"std {deployed[1]:.2f} over {len(cells)} seeds"
            note = (
                f"{spread}, divided by {deployed[2]:.1f} m; ideal car over the same frames "
                f"{ideal[0]:.2f} x of {ideal[2]:.1f} m; {options.victim} victim"
            )
            print(f"\n{target} {scenario} {method}: deployed {deployed[0]:.2f} x; {note}")
            wanted = TARGETS.get((target, scenario)) if method == "gradient" and options.victim == "hardened" else None
            if not options.trial:
                record_row(f"#5 meshes: {target_name}{objects}, {scenario}, {method}{of_victim}, deployed", deployed[0], "x", f">= {wanted} x" if wanted else "printed",
                           None if wanted is None or len(cells) < _SEEDS else deployed[0] >= wanted, command, note)  # fmt: skip


if __name__ == "__main__":
    main()
