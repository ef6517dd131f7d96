"""Question: what does an attack add to the steering, frame by frame, on a live drive? ``python -m benchmarks.counterfactual_live RUN_FOLDER``.

The green screen's gradient attack of a finished run folder of the room is driven twice through the node graph: as it was, and with the
counterfactual node, which lets the same policy steer by the clean and by the attacked frame. From the bags: the difference, how many
frames were compared, and whether the way of a command took longer for it. Needs idle cores.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

from advnerf_core.attack.artifact import load_attack
from benchmarks.results import record_row
from nodes.evaluation import Counterfactual, Timing, attack_ids, counterfactual, timing
from nodes.experiment.attack import Search, attack_path
from nodes.experiment.context import CONTROL_PERIOD_S, Experiment
from nodes.experiment.deploy import LiveRun, live_horizon, live_overrides
from nodes.experiment.run import load_experiment
from nodes.runtime.clock import NS_PER_S
from nodes.trial import TrialPlan
from nodes.trial_runner import run_trial
from nodes.trials.campaign import COUNTED_STOPS

LIVE = LiveRun("hardened", "gradient", 0)


def drive(experiment: Experiment, folder: Path, compare: bool) -> tuple[Timing, Counterfactual | None]:
    """One live drive past the attack; what its bag says of the way of a command, and of the comparison."""
    shutil.rmtree(folder, ignore_errors=True)
    attack = attack_path(experiment.stage_folder("attack"), Search("hardened", "gradient", 0))
    overrides, nodes = live_overrides(experiment, LIVE, attack), list(experiment.config.deploy.nodes)
    if compare:
        overrides, nodes = [*overrides, "params.counterfactual=true"], [*nodes, "counterfactual"]
    horizon = live_horizon(experiment, LIVE)
    plan = TrialPlan(experiment.room.start_pose, horizon.ticks * horizon.dt_s + 0.2, tuple(nodes))
    outcome = run_trial(experiment.launch_file, overrides, folder, plan, experiment.config.deploy.ready_timeout_s)
    if outcome.stopped_early and not any(word in outcome.stopped_early for word in COUNTED_STOPS):
        raise SystemExit(f"the stack stopped the drive: {outcome.stopped_early}; run it again on idle cores")
    if (shown := attack_ids(folder / "bag")) != {load_attack(attack).attack_id}:
        raise SystemExit(f"expected {load_attack(attack).attack_id} in the frames of {folder}, got {sorted(shown)}")
    last_frame_ns = outcome.end_real_ns - round(CONTROL_PERIOD_S * NS_PER_S)
    times = timing(folder / "bag", outcome.start_real_ns, last_frame_ns)
    return times, counterfactual(folder / "bag", outcome.start_real_ns, last_frame_ns)


def main() -> None:
    """Drive twice, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the room's experiment")
    parser.add_argument("--out", type=Path, default=Path("runs/counterfactual"))
    parser.add_argument("--dry", action="store_true", help="print only")
    options = parser.parse_args()
    experiment = load_experiment(Path("launch/room.experiment.yaml"), "full", [], options.folder)
    alone, _ = drive(experiment, options.out / "without", compare=False)
    times, found = drive(experiment, options.out / "with", compare=True)
    if found is None or found.mean_abs_delta_rad is None:
        raise SystemExit("expected comparisons of frames into which the attack was drawn, got none")
    p99, p99_alone = (float(np.percentile(each.capture_to_serial_ms, 99)) for each in (times, alone))
    rows = [
        (
            "#5 counterfactual steering live: what the attack adds", found.mean_abs_delta_rad, "rad mean abs",
            f"{found.frames_drawn} frames with the attack, {found.frames} compared of {times.frames} frames of the drive; to one side "
            f"{found.mean_delta_rad:+.3f} rad, at most {found.max_abs_delta_rad:.3f} rad after {found.max_at_s:.1f} s",
        ),
        (
            "#5 counterfactual steering live: capture to serial write", p99, "ms p99",
            f"{p99_alone:.1f} ms on the same drive without the comparison; frames missed {times.missed} and {alone.missed}",
        ),
    ]  # fmt: skip
    for line, value, unit, note in rows:
        print(f"{line}: {value:.3g} {unit}; {note}")
        if not options.dry:
            record_row(
                line, value, unit, "printed", None, f"python -m benchmarks.counterfactual_live {options.folder}", note
            )


if __name__ == "__main__":
    main()
