"""Selects the cells of an experiment that the fidelity gate admits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import NONE
from advnerf_core.scene.gate_limits import GateLimits
from nodes.experiment.engine.artefact import PUBLISHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import has_learned_scene
from nodes.experiment.run.store import Store
from nodes.experiment.show.context import Experiment
from nodes.runtime.errors import RuntimeFault


def past_the_gate(
    experiment: Experiment, cells: Sequence[Cell], leave_out: bool, say: Callable[[str], None]
) -> list[Cell]:
    """The cells whose surrogate is good enough; judged once per variant, path and victim, and stored.

    Every rejection is said; unless ``leave_out`` is set, it is only a warning.
    """
    passed: dict[str, bool] = {}
    for cell in cells:
        if (key := gate_key(cell)) not in passed:
            passed[key] = _judge(experiment, cell, leave_out, say)
    return [cell for cell in cells if passed[gate_key(cell)]]


def _judge(experiment: Experiment, cell: Cell, leave_out: bool, say: Callable[[str], None]) -> bool:
    """Whether the cells of this one's place and victim may be run: by held-out views, and by a drive without attack if there is one."""
    of, key = experiment.of(cell), gate_key(cell)
    limits = of.config.gate  # by default the experiment itself judges, see `steering_gate`
    if not isinstance(limits, GateLimits) or not has_learned_scene(of):
        return True
    from nodes.experiment.run.gate import cached_verdict  # loads torch

    without = next(
        each for each in (*experiment.cells, cell.clean) if each.method == NONE and gate_key(each) == key
    )
    which = (of, without.inside, limits)
    published = PUBLISHED / experiment.config.name
    # Its variants share the verdict on held-out views, each under its own name.
    held_out = [file for file in sorted(published.glob("gate/*.json")) if not file.stem.endswith(".drive")]
    found = [cached_verdict(*which, gate_file(experiment.folder, key), published=held_out)]
    try:
        drive = Store(experiment.folder).work(without.name)
        file, also = (gate_file(folder, key, drive=True) for folder in (experiment.folder, published))
        found.append(cached_verdict(*which, file, drive, [also]))
    except RuntimeFault as fault:
        say(
            f"fidelity gate, {key}: only held-out views are judged, as there is no drive without attack yet: {fault}"
        )
    may = not leave_out or all(verdict is None or verdict.passed for verdict in found)
    for reason in [reason for verdict in found if verdict is not None for reason in verdict.reasons]:
        left_out = "" if may else "; its cells are left out (--no-gate runs them all the same)"
        say(f"fidelity gate, {key}: {reason}{left_out}")
    return may


def gate_file(folder: Path, key: str, drive: bool = False) -> Path:
    """File of the verdict on held-out views, or on a drive without attack, in an experiment's folder or a published set."""
    return folder / "gate" / f"{key}{'.drive' * drive}.json"


def gate_key(cell: Cell | CellResult) -> str:
    """Name of the verdict that applies to a cell."""
    return f"{cell.scenario}_{cell.victim}"
