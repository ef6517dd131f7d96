"""Hashes that are fixed before the first search against a victim, so that nothing can be changed once results are known."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from advnerf_core.report.evidence.hardness import FILE, read_hardness
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.engine.run_folder import FROZEN
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import has_face, panel_of
from nodes.experiment.show.given import victim_sha256
from nodes.experiment.show.learned_scene import scene_sha256
from nodes.experiment.show.spaces import named_objects
from nodes.runtime.errors import RuntimeFault


class FrozenChangedError(RuntimeFault):
    """Something that was fixed before the first attack has changed."""


def frozen_hashes(experiment: Experiment) -> dict[str, str]:
    """Hashes fixed before the first attack: scene, victims, objects and their places, starts and seeds."""
    policies = {f"policy_{name}": victim_sha256(experiment, name) for name in experiment.config.attacked}
    starts = {
        f"{scenario} {seed}": experiment.start_states(scenario, seed).tolist()
        for scenario in experiment.config.paths
        for seed in experiment.config.seeds
    }
    starts |= {name: experiment.measured_starts(name).tolist() for name in experiment.config.paths}
    return {
        **_frozen_place(experiment),
        **policies,
        "starts_and_seeds": hash_of(starts),
        # As the experiment was run: a report may have fewer methods.
        "config": hash_of(read_json(experiment.folder / "manifest.json")["config"]),
    }


def frozen_for(experiment: Experiment, cell: Cell) -> dict[str, str]:
    """Hashes fixed before the search of a cell; they do not depend on other seeds and victims."""
    return {
        **_frozen_place(experiment),
        "policy": victim_sha256(experiment, cell.victim),
        "starts": hash_of(
            [
                experiment.start_states(cell.scenario, cell.seed).tolist(),
                experiment.measured_starts(cell.scenario).tolist(),
            ]
        ),
    }


def _frozen_place(experiment: Experiment) -> dict[str, str]:
    """Scene, objects, and their places."""
    things = experiment.objects
    return {
        "scene": scene_sha256(experiment),
        "objects": hash_of([each.sha256 for each in named_objects(experiment)]),
        "placement": hash_of(
            [thing.place for thing in things]
            + ([panel_of(experiment).to_dict()] if has_face(experiment) else [])
        ),
    }


def freeze(experiment: Experiment, cell: Cell, folder: Path) -> None:
    """Write the hashes fixed before the search of a cell, once."""
    if not (folder / FROZEN).exists():
        fixed = frozen_for(experiment, cell)
        # Without a passing verdict no page calls the victim hardened.
        verdict = read_hardness(experiment.folder / FILE).passing(fixed["policy"])
        fixed["hardness"] = "" if verdict is None else verdict.digest
        write_json(folder / FROZEN, fixed)


def hardness_before(folder: Path) -> str:
    """Digest of the victim's passing verdict when a search began; empty without one."""
    return str(read_json(folder / FROZEN).get("hardness", "")) if (folder / FROZEN).exists() else ""


def check_frozen(experiment: Experiment, cell: Cell, folder: Path) -> None:
    """Raise if scene, victims, objects, places or starts differ from the search's.

    Raises:
        FrozenChangedError: One of them changed.
    """
    then, now = read_json(folder / FROZEN), frozen_for(experiment, cell)
    changed = [name for name, value in now.items() if then.get(name) != value]
    if changed:
        raise FrozenChangedError(
            f"expected {', '.join(changed)} as frozen before the search in {folder}, got another; remove that folder to search again"
        )
