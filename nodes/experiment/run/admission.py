"""Which cells of a campaign the fidelity gate lets run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import NONE
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import has_learned_scene
from nodes.experiment.run.config import Campaign
from nodes.experiment.run.plan import read_experiment
from nodes.experiment.run.store import store_of
from nodes.runtime.errors import RuntimeFault


def past_the_gate(
    campaign: Campaign, cells: Sequence[Cell], leave_out: bool, say: Callable[[str], None]
) -> list[Cell]:
    """The cells whose surrogate is good enough; judged once per scenario and victim, and kept.

    Args:
        campaign: The campaign.
        cells: Which of its cells.
        leave_out: Whether cells of a refused surrogate are left out; else it is only told.
        say: Told of every refusal.
    """
    passed: dict[str, bool] = {}
    for cell in cells:
        if (key := gate_key(cell)) not in passed:
            passed[key] = _judge(campaign, cell, leave_out, say)
    return [cell for cell in cells if passed[gate_key(cell)]]


def _judge(campaign: Campaign, cell: Cell, leave_out: bool, say: Callable[[str], None]) -> bool:
    """Whether the cells of this one's scenario and victim may be run: by held-out views, and by a drive without attack where there is one."""
    scenario = campaign.scenario(cell)
    experiment, key = read_experiment(campaign, cell), gate_key(cell)
    limits = scenario.gate or campaign.gate
    if limits is None or not has_learned_scene(experiment):
        return True
    from nodes.experiment.run.gate import cached_verdict  # loads torch

    without = next(
        each for each in (*campaign.cells, cell.clean) if each.method == NONE and gate_key(each) == key
    )
    which = (experiment, campaign.inside(without), limits)
    found = [cached_verdict(*which, gate_file(campaign.folder, key))]
    try:
        drive = store_of(campaign).work(without.name)
        found.append(cached_verdict(*which, gate_file(campaign.folder, key, drive=True), drive))
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
    """Where a campaign, or what is published of it, keeps the verdict on held-out views, or on a drive without attack."""
    return folder / "gate" / f"{key}{'.drive' * drive}.json"


def gate_key(cell: Cell | CellResult) -> str:
    """Name of what the fidelity gate judges for a cell."""
    return f"{cell.scenario}{'.' * bool(cell.placement)}{cell.placement}_{cell.victim}"
