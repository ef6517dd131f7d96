"""What an experiment in a small setting was, and what it took, in a few lines of text for its end."""

from __future__ import annotations

from statistics import fmean

from advnerf_core.documents import read_json
from advnerf_core.report.cells import CellResult, read_cell
from advnerf_core.report.conditions import NONE
from nodes.experiment.engine.artefact import read_artefact
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.pipeline import stages_of


def setting_lines(experiment: Experiment) -> list[str]:
    """Setting, held-out views, the victims' own errors, and seconds of each part; of what is finished."""
    config = experiment.config
    cells = [read_cell(file) for cell in experiment.cells if (file := experiment.cell_result(cell)).exists()]
    lines = [
        f"setting {experiment.setting}: {config.horizon} ticks driven, {config.attack.horizon} searched over, "
        f"{config.attack.evaluations} evaluations from {config.attack.starts} starts, "
        f"seeds {', '.join(map(str, config.seeds))}, methods {', '.join([NONE, *config.method_names])}",
        _scene(experiment),
        _victims(cells),
        _seconds(experiment, cells),
    ]
    return [line for line in lines if line]


def _scene(experiment: Experiment) -> str:
    try:
        mean = read_json(experiment.stage_folder("scene") / "fidelity.json")["mean"]
    except (OSError, ValueError, KeyError):
        return ""
    return f"held-out views: {mean['psnr_full_db']:.1f} dB at full size, {mean['psnr_policy_db']:.1f} dB as the policy sees them"


def _victims(cells: list[CellResult]) -> str:
    own = {cell.victim: cell.deployed for cell in cells if cell.method == NONE}
    said = [
        f"{victim} {'not driven live' if found is None else f'{fmean(found.total_cte_m):.2f} m'}"
        for victim, found in own.items()
    ]
    return f"total CTE of the victims without attack, live: {', '.join(said)}" if said else ""


def _seconds(experiment: Experiment, cells: list[CellResult]) -> str:
    """Stages that are taken from elsewhere count with the seconds that they took there."""
    names = [*(stage.name for stage in stages_of(experiment)), "report"]
    found = {name: read_artefact(experiment.stage_folder(name)) for name in names}
    spent = {name: each.seconds for name, each in found.items() if each is not None}
    spent["cells"] = sum(cell.seconds for cell in cells)
    return "seconds: " + ", ".join(f"{name} {seconds:.0f}" for name, seconds in spent.items())
