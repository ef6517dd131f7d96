"""Stage deploy: every cell's drive in the deployment scene, tick by tick, with its own car and opaque objects."""

from __future__ import annotations

import json
from pathlib import Path

from nodes.experiment.junction.attack import cells, frozen_hashes
from nodes.experiment.junction.cells import deployed_part
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.objects import placed_objects
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.progress import Report


class FrozenChangedError(RuntimeFault):
    """Something that was fixed before the first attack is no longer what it was."""


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Drive what is not driven yet; one ``.cell.json`` per entry of the transfer table."""
    check_frozen(experiment)
    searched, plan = experiment.stage_folder("attack"), cells(experiment)
    with experiment.site.open() as scene:
        dressed = DressedScene(scene, experiment.view, placed_objects(experiment))
        for index, cell in enumerate(plan):
            report(index / len(plan), f"{cell.scenario} {cell.victim} {cell.method} seed {cell.seed}")
            deployed_part(experiment, dressed, cell, searched, folder)


def check_frozen(experiment: Experiment) -> None:
    """Refuse to drive if scene, victims, objects, places or starts are not those of the attack."""
    then = json.loads((experiment.stage_folder("attack") / "frozen.json").read_text())
    now = frozen_hashes(experiment)
    changed = [name for name, value in now.items() if name != "config" and then.get(name) != value]
    if changed:
        raise FrozenChangedError(
            f"expected {', '.join(changed)} as frozen before the first attack, got another; run the attack stage again"
        )
