"""Row: a policy trained only from bags of the expert driving the twin drives three laps live.

Three stages under ``runs/policy_from_bags``, each kept once it is there: collect (``launch/collect.launch.yaml``: the expert
disturbs itself and corrects), train (``nodes/lab/policy_data``, labels by the expert at the recorded poses), drive (three laps of the
policy alone, scored from the bag). One DAgger round by relabelling lies between: the policy drives, the expert says what it
should have done, and the training is done again on everything. Run as ``python -m benchmarks.policy_from_bags [--trial]``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import socket
from pathlib import Path

from advnerf_core.data.logs.choice import LogChoice, LogRequest
from advnerf_core.documents import read_json
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.metrics import Horizon
from advnerf_core.files import write_atomically
from advnerf_core.learning.recipe import ImitationConfig
from advnerf_core.policies.view import PolicyView
from benchmarks.results import record_row
from calibration.schema import CameraCalibration, RoomCalibration, load_calibration
from nodes.lab.policy_data.logs import open_logs
from nodes.lab.policy_data.train import Training, train_from_recordings
from nodes.lab.trials.evaluation import score, trajectory
from nodes.lab.trials.trial import TrialOutcome, TrialPlan
from nodes.lab.trials.trial_runner import run_trial
from nodes.launching.launch import Launch
from nodes.runtime.clock import NS_PER_S

_ROOT = Path(__file__).parents[1]
_LAUNCH = _ROOT / "launch" / "collect.launch.yaml"
_CALIBRATION = _ROOT / "calibration" / "twin"
_TICK_S, _SPEED_MPS = 0.1, 0.8
_NODES = ("camera", "vicon", "policy", "safety", "motor")
_READY_S = 60.0
_TARGET_M = 0.08


def collect(folder: Path, laps: float, timeout_s: float) -> Path:
    """Bag of the expert's drives."""
    run_dir = folder / "collect"
    if not (run_dir / "done.json").is_file():
        shutil.rmtree(run_dir, ignore_errors=True)
        overrides = [*_common(), f"collect.laps={laps}"]
        with Launch(_LAUNCH, overrides, run_dir) as launch:
            launch.wait_ready(_READY_S)
            ended = launch.wait(timeout_s)
        if launch.failure or ended is None:
            raise SystemExit(f"collecting failed: {launch.failure or f'not done after {timeout_s:.0f} s'}")
        write_atomically(run_dir / "done.json", json.dumps({"laps": laps}) + "\n")
    return run_dir / "bag"


def train(bags: list[Path], out: Path, steps: int) -> Training:
    """Policy from bags alone."""
    camera = load_calibration(CameraCalibration, _CALIBRATION / "camera.yaml")
    room = load_calibration(RoomCalibration, _CALIBRATION / "room.yaml")
    view = PolicyView(camera.pinhole, distortion=camera.distortion)
    expert = Expert(room.reference_path, ExpertConfig(speed_mps=_SPEED_MPS))
    logs = open_logs(map(LogRequest, bags), LogChoice(), "expert")
    return train_from_recordings(logs, view, expert, ImitationConfig(first_steps=steps), out, progress=_say)


def drive(policy: Path, run_dir: Path, laps: float) -> TrialOutcome:
    """Laps of the policy alone, live; the outcome is kept beside the bag."""
    room = load_calibration(RoomCalibration, _CALIBRATION / "room.yaml")
    duration_s = laps * room.reference_path.length_m / _SPEED_MPS
    if not (run_dir / "trial.json").is_file():
        shutil.rmtree(run_dir, ignore_errors=True)
        overrides = [
            *_common(),
            "policy.if=true",
            f"params.policy={policy}",
            "expert.if=false",
            "collect.if=false",
            "safety.drivers=[policy]",
            f"safety.nodes={json.dumps([n for n in _NODES if n != 'safety'])}",
        ]
        run_trial(_LAUNCH, overrides, run_dir, TrialPlan(room.start_pose, duration_s + 0.2, _NODES), _READY_S)
    return TrialOutcome(**read_json(run_dir / "trial.json"))


def mean_abs_cte_m(run_dir: Path, outcome: TrialOutcome, laps: float) -> tuple[float, float]:
    """Mean and largest |CTE| of a drive [m]; a stack that stopped it early is scored where it stood."""
    room = load_calibration(RoomCalibration, _CALIBRATION / "room.yaml")
    ticks = round(laps * room.reference_path.length_m / _SPEED_MPS / _TICK_S)
    horizon = Horizon(ticks, _TICK_S, room.off_track_m)
    stopped_s = (outcome.end_real_ns - outcome.start_real_ns) / NS_PER_S if outcome.stopped_early else None
    states = trajectory(run_dir / "bag", outcome.start_real_ns, horizon)
    metrics, _ = score(states, room.reference_path, horizon, stopped_s)
    return float(metrics.mean_cte_m), float(metrics.max_cte_m)


def main() -> None:
    """Run what is not there yet, and record the row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trial", action="store_true", help="a small size; records nothing")
    parser.add_argument("--folder", type=Path, default=None)
    arguments = parser.parse_args()
    trial = arguments.trial
    folder = arguments.folder or _ROOT / "runs" / ("policy_from_bags_trial" if trial else "policy_from_bags")
    laps, collect_laps, steps, rounds = (0.5, 0.4, 60, 0) if trial else (3.0, 2.0, 800, 1)
    bags = [collect(folder, collect_laps, 60.0 + 5 * 60.0 * collect_laps)]
    for number in range(rounds):
        # The laps that are scored are not among what is learned from: a round's drive is a bag of its own.
        policy = train(bags, folder / f"policy{number}", steps)
        drive(policy.path, folder / f"dagger{number}", 2.0)
        bags.append(folder / f"dagger{number}" / "bag")
    done = train(bags, folder / "policy", steps)
    outcome = drive(done.path, folder / "drive", laps)
    mean_m, max_m = mean_abs_cte_m(folder / "drive", outcome, laps)
    early = f", stopped early: {outcome.stopped_early}" if outcome.stopped_early else ""
    print(
        f"{laps:g} laps: mean |CTE| {mean_m:.3f} m, worst {max_m:.3f} m{early}; {sum(done.frames.values())} frames"
    )
    if not trial:
        record_row(
            "policy trained only from bags of the expert driving the twin, 3 laps live, mean |CTE|",
            round(mean_m, 3),
            "m",
            f"<= {_TARGET_M} m, 3 laps",
            mean_m <= _TARGET_M and not outcome.stopped_early,
            "python -m benchmarks.policy_from_bags",
            f"worst {max_m:.2f} m, {sum(done.frames.values())} frames, one DAgger round by relabelling{early}",
        )


def _common() -> list[str]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return [f"params.vicon_port={port}", f"params.calibration={_CALIBRATION}"]


def _say(fraction: float, text: str = "") -> None:
    if fraction in (0.0, 1.0) or round(1000 * fraction) % 100 == 0:
        print(f"{100 * fraction:.0f} % {text}", flush=True)


if __name__ == "__main__":
    main()
