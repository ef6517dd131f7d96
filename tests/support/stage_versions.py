"""Numbers and defaults that say whether stages and cells still make what they made: ``python -m tests.support.stage_versions`` records them.

A tiny experiment in the lab, of which every part is summed up in a few numbers. They are the same from run to run, and nearly the same
from machine to machine.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from pydantic import BaseModel
from pydantic_core import to_jsonable_python

if TYPE_CHECKING:
    from nodes.experiment.show.context import Experiment
    from nodes.runtime.progress import StageDisplay

ROOT = Path(__file__).parents[2]
RECORDED = ROOT / "tests" / "nodes" / "experiment" / "versions.json"
TINY = (
    "capture.photos=12", "capture.colour_pairs=2", "capture.held_out=3", "scene.steps=12", "scene.log2_entries=12", "scene.occupancy=32",
    "scene.decay=exponential", "scene.learning_rate=0.01",  # twelve steps at more learn nothing that could be baked
    "policy.deployed_stills=12", "policy.surrogate_stills=8", "policy.deployed_drives=1", "policy.surrogate_drives=2",
    "policy.drive_steps=3", "policy.first_steps=6", "policy.round_steps=3", "policy.naive_steps=0",
    "attack.horizon=6", "attack.evaluations=2", "carrier.resolution=8", "horizon=8", "deploy.through=world",
    "gate=null",
)  # fmt: skip


def measured(folder: Path, watcher: StageDisplay | None = None) -> dict[str, dict[str, Any]]:
    """Version and numbers of every stage and of cells.

    Args:
        folder: Gets the run folder.
        watcher: Receives the starts and ends of the stages.
    """
    from advnerf_core.data.transforms import load_transforms
    from advnerf_core.objects.voxel.build import build_from_mesh
    from advnerf_core.objects.voxel.generators import GENERATORS
    from advnerf_core.objects.voxel.mesh import stand
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.run.cells import Bench, run_cell
    from nodes.experiment.steps.run import make_ready

    experiment = tiny_experiment(folder)
    make_ready(experiment, anew=True, watcher=watcher)
    views = load_transforms(experiment.stage_folder("capture") / "held_out", require_all=True).load()
    fidelity = json.loads((experiment.stage_folder("scene") / "fidelity.json").read_text())["mean"]
    baked = json.loads((experiment.stage_folder("bake") / "baked.json").read_text())
    policy = json.loads((experiment.stage_folder("policy") / "policy.json").read_text())
    hydrant = build_from_mesh(stand(GENERATORS["hydrant"]()), "hydrant", 12, 0, {}).placed(np.eye(4), 1.0)
    totals = {}
    with Bench(experiment) as bench:
        for method in ("none", "random", "gradient"):
            cell = Cell("track", "hardened", method, 0)
            found = run_cell(
                experiment, cell, experiment.cell_folder(cell), lambda part, text="": None, bench
            )
            totals[f"{method}_surrogate_m"] = found["surrogate"]["total_cte_m"][0]
            totals[f"{method}_deployed_m"] = found["deployed"]["total_cte_m"][0]
    numbers: dict[str, dict[str, float]] = {
        "capture": {"mean_grey_levels": float(np.mean([rgb.mean() for rgb in views.rgb]))},
        "scene": {name: float(value) for name, value in fidelity.items()},
        "bake": {"psnr_db": float(baked["psnr_baked_db"]), "used": float(baked["used"])},
        "object": {"free_colours": float(hydrant.free_count)},
        "policy": {
            "frames": float(policy["frames"]),
            "mean_control": float(np.mean([abs(row["real"]) for row in policy["on_held_out_views"]])),
        },
        "cells": totals,
    }
    return {
        name: {"version": version, "numbers": numbers.get(name, {})} for name, version in versions().items()
    }


def versions() -> dict[str, int]:
    """Version of every stage and of cells."""
    from nodes.experiment.steps import keys
    from nodes.experiment.steps.pipeline import VERSIONS

    return {**VERSIONS, "cells": keys.VERSION}


def defaults() -> dict[str, dict[str, Any]]:
    """Defaults of all settings that every stage and cells read, by their names with dots; what is in a union has its class in the name."""
    from nodes.experiment.plan.config import ExperimentConfig
    from nodes.experiment.steps import keys
    from nodes.experiment.steps.pipeline import READS

    found = {name: dict(sorted(_defaults(ExperimentConfig, include))) for name, include in READS.items()}
    # Of what stages alone read cells have the digests.
    by_digest = dict.fromkeys(("capture", "scene", "policy"), True)
    found["cells"] = dict(sorted(_defaults(ExperimentConfig, True, {**keys.FREE, **by_digest})))
    return found


def _defaults(
    model: type[BaseModel], include: Any, exclude: Any = None, at: str = ""
) -> Iterator[tuple[str, Any]]:
    for name, field in model.model_fields.items():
        wanted, unwanted = _part(include, name), _part(exclude, name)
        if not wanted or unwanted is True:
            continue
        inside = models_in(field.annotation)
        for each in inside:
            between = f"{each.__name__}." if len(inside) > 1 else ""
            yield from _defaults(each, wanted, unwanted, f"{at}{name}.{between}")
        if not field.is_required():
            default = field.get_default(call_default_factory=True)
            short = (
                default.model_dump(mode="json", exclude_defaults=True)
                if isinstance(default, BaseModel)
                else default
            )
            yield f"{at}{name}", to_jsonable_python(short)


def _part(fields: Any, name: str) -> Any:
    """What a text of `BaseModel.model_dump` says of a field: True for all of it, None for nothing."""
    if isinstance(fields, Mapping):
        return fields.get("__all__", fields.get(name))
    return True if fields is True or (fields and name in fields) else None


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Models that an annotation names, also in unions and containers."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for each in get_args(annotation) for model in models_in(each)]


def tiny_experiment(folder: Path, changes: Sequence[str] = ()) -> Experiment:
    """The experiment that is summed up.

    Args:
        folder: The run folder.
        changes: More ``key=value`` texts.
    """
    from nodes.experiment.steps.run import load_experiment

    return load_experiment(ROOT / "launch" / "room.experiment.yaml", "demo", [*TINY, *changes], folder)


def main() -> None:
    """Write what is made now."""
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder) / "run")
    before = json.loads(RECORDED.read_text())
    for name, each in defaults().items():
        found[name]["defaults"] = each
        known = before.get(name, {}).get("defaults", {})
        changed = [key for key in each.keys() & known.keys() if each[key] != known[key]]
        if changed and found[name]["version"] == before[name]["version"]:
            raise SystemExit(
                f"{name}: expected another version with other {', '.join(changed)}; raise it first"
            )
    RECORDED.write_text(json.dumps(found, indent=1) + "\n")
    print(f"wrote {RECORDED.relative_to(ROOT)}: {sys.version.split()[0]}")


if __name__ == "__main__":
    main()
