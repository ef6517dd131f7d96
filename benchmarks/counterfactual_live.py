"""Question: what does an attack add to the steering, frame by frame, on a live drive? ``python -m benchmarks.counterfactual_live RUN_FOLDER``.

The green screen's gradient attack of a finished run folder of the room is driven twice through the node graph: as it was, and with the
counterfactual node, which lets the same policy steer by the clean and by the attacked frame. From the bags: the difference, how many
frames were compared, and whether the way of a command took longer for it. Needs idle cores.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results import record_row
from nodes.experiment.engine.run_folder import ATTACK
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.live import LiveNodes, LiveRun, drive_live
from nodes.experiment.steps.run import load_experiment
from nodes.lab.trials.trial import SpoiledError

CELL = Cell("track", "hardened", "gradient", 0)


def drive(experiment: Experiment, folder: Path, compare: bool) -> dict[str, Any]:
    """One live drive past the attack; what was measured in its bag."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    attack = (experiment.cell_folder(CELL) / ATTACK).resolve()
    start = experiment.references[CELL.scenario].drive_start
    live = LiveRun(CELL.name, CELL.victim, CELL.scenario, start, attack, compare=compare)
    try:
        with LiveNodes(experiment) as nodes:
            return drive_live(experiment, live, folder, nodes)
    except SpoiledError as error:
        raise SystemExit(f"the drive does not count: {error}; run it again on idle cores") from None


def main() -> None:
    """Drive twice, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the room's experiment")
    parser.add_argument("--out", type=Path, default=Path("runs/counterfactual"))
    parser.add_argument("--dry", action="store_true", help="print only")
    options = parser.parse_args()
    experiment = load_experiment(Path("launch/room.experiment.yaml"), "full", [], options.folder)
    alone = drive(experiment, options.out / "without", compare=False)
    compared = drive(experiment, options.out / "with", compare=True)
    found = compared.get("counterfactual")
    if found is None or found["mean_abs_delta_rad"] is None:
        raise SystemExit("expected comparisons of frames into which the attack was drawn, got none")
    p99, p99_alone = (float(np.percentile(each["capture_to_serial_ms"], 99)) for each in (compared, alone))
    rows = [
        (
            "counterfactual steering live: what the attack adds",
            found["mean_abs_delta_rad"],
            "rad mean abs",
            f"{found['frames_drawn']} frames with the attack, {found['frames']} compared of {compared['frames']} frames of the drive; to one "
            f"side {found['mean_delta_rad']:+.3f} rad, at most {found['max_abs_delta_rad']:.3f} rad after {found['max_at_s']:.1f} s",
        ),
        (
            "counterfactual steering live: capture to serial write",
            p99,
            "ms p99",
            f"{p99_alone:.1f} ms on the same drive without the comparison; frames missed {compared['missed']} and {alone['missed']}",
        ),
    ]
    for line, value, unit, note in rows:
        print(f"{line}: {value:.3g} {unit}; {note}")
        if not options.dry:
            record_row(
                line,
                value,
                unit,
                "printed",
                None,
                f"python -m benchmarks.counterfactual_live {options.folder}",
                note,
            )


if __name__ == "__main__":
    main()
