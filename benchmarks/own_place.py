"""``advnerf audit`` as a new user runs it: an own ONNX policy, photographs of a drive, and what the place itself says of the verdict.

The photographs are rendered in the simulated lab, which the command does not know: it is given their folder alone. What it finds in its learned
copies is then driven past in the lab, by the lab's own car, from 50 starts of their own. ``python -m benchmarks.own_place [--budget 15m | --ci]``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.policies.adapter import adapted
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import load_any_policy
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.report.audit_result import AuditResult, read_audit
from benchmarks.results import REPOSITORY, record_row
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.audit.comparing import ATTACK_KEPT
from nodes.audit.drives import FOUND, NO_OBJECT, PLAIN_OBJECT, arm_of, driven, with_starts
from nodes.audit.kept import check_audit
from nodes.audit.learning import OTHER_HALF
from nodes.audit.question import FILE, VICTIM
from nodes.audit.verdict import effect_of
from nodes.experiment.steps.run import load_experiment
from tests.support.lab_photographs import photograph

COMMAND = "python -m benchmarks.own_place"
VICTIM_FILE = REPOSITORY / "docs/results/reference/policy_722ab9106e2fbad0/policy.safetensors"
PHOTOGRAPHS, LIMIT_M, STARTS, SEED = 160, 0.4, 50, 30_000
# How a person drives: off the line and turned by this much, several times a lap.
_WOBBLE_M, _TURNED_RAD = 0.05, 0.08
WORDS = ("my_policy.onnx", "--place", "photos", "--car", "my_car.yaml", "--limit", str(LIMIT_M))
_CAR = "car: {speed_mps: 0.8, wheelbase_m: 0.25, max_steering_rad: 0.26}\ncamera_ahead_m: 0.3\ncamera_height_m: 0.2\n"


def make_folder(folder: Path) -> None:
    """A lap by hand, photographed by the driving camera."""
    with Lab(LabConfig()) as lab:
        path, states = lab.describe().paths["track"], []
        for index in range(PHOTOGRAPHS):
            share = index / PHOTOGRAPHS
            x, y, yaw = path.pose_at(path.length_m * share)
            off_m = _WOBBLE_M * np.sin(18 * np.pi * share)
            turned = yaw + _TURNED_RAD * np.cos(14 * np.pi * share)
            states.append((x - off_m * np.sin(yaw), y + off_m * np.cos(yaw), turned))
        photograph(lab, states, folder / "photos")
    loaded = load_any_policy(VICTIM_FILE)
    policy = adapted(loaded.policy, PolicyContract(loaded.view))
    export_onnx(policy.network, policy.contract, folder / "my_policy.onnx")
    (folder / "my_car.yaml").write_text(_CAR)


def run_audit(folder: Path, output: str, *words: str) -> tuple[AuditResult, float]:
    """``advnerf audit`` in a user's folder: its result, checked against its drives, and how long it took [min]."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    began = time.monotonic()
    command = [sys.executable, "-m", "nodes.cli", "audit", *words, "-o", output]
    ended = subprocess.run(command, cwd=folder, env=environment, check=False)
    minutes = (time.monotonic() - began) / 60.0
    result = read_audit(folder / output / "audit.json")
    assert ended.returncode == result.exit_code, f"the command ended with {ended.returncode}"
    print("\n".join(check_audit(folder / output)))
    return result, minutes


def run_small(folder: Path) -> None:
    """The setting for continuous integration, twice: how long it takes, and whether it says the same."""
    (result, first), (_, second) = (run_audit(folder, name, *WORDS, "--ci") for name in ("one", "two"))
    minutes = max(first, second)
    same = (folder / "one" / "audit.json").read_bytes() == (folder / "two" / "audit.json").read_bytes()
    record_row(
        "audit in the setting for continuous integration, learning the place included",
        round(minutes, 1), "min", "<= 8 min on 2 cores; the same bytes again", minutes <= 8.0 and same, f"{COMMAND} --ci",
        f"{result.verdict.outcome}, {PHOTOGRAPHS} pictures; the second run gave {'the same bytes' if same else 'OTHER bytes'}",
    )  # fmt: skip


def drive_in_the_lab(folder: Path) -> dict[str, tuple[int, float, float, float]]:
    """Starts off the lane, and the effect over no object with its interval [m], of what was found, past the lab's own car."""
    settings = read_json(folder / "audit" / "plan.json")["settings"]
    result = read_audit(folder / "audit" / "audit.json")
    assert result.strongest is not None, "an object was judged"
    pose = result.strongest.object.pose
    setting = next(
        name for name, values in settings.items() if _stands_at(values["objects"][0], pose.x_m, pose.y_m)
    )
    experiment = load_experiment(
        folder / "audit" / FILE, setting, ["world.half=odd", "scene.seed=1"], folder / "audit" / OTHER_HALF
    )
    experiment = with_starts(experiment, STARTS, SEED)
    attack = folder / "audit" / ATTACK_KEPT
    with Lab(LabConfig()) as lab:
        found = {
            name: driven(experiment, VICTIM, arm_of(experiment, name, attack), lab)
            for name in (NO_OBJECT, PLAIN_OBJECT, FOUND)
        }
    rows = {}
    for name, drives in found.items():
        effect = effect_of(drives, found[NO_OBJECT])
        rows[name] = (int(drives.left(LIMIT_M).sum()), effect.mean_m, effect.low_m, effect.high_m)
    return rows


def _stands_at(listed: dict[str, float], x_m: float, y_m: float) -> bool:
    return (listed["x_m"], listed["y_m"]) == (x_m, y_m)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--budget", default="15m")
    parser.add_argument("--ci", action="store_true", help="measure the small setting instead")
    options = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_folder(folder)
        if options.ci:
            run_small(folder)
            return
        result, minutes = run_audit(folder, "audit", *WORDS, "--budget", options.budget)
        there = drive_in_the_lab(folder)
    judged = result.judgement
    effect = (
        ""
        if judged is None
        else f"; {judged.off_track} of {len(judged.starts)} starts off the lane in the copy"
    )
    record_row(
        "audit of an own ONNX policy in photographs of an own drive: from nothing to the verdict",
        round(minutes, 1),
        "min",
        "one command, <= 3 questions, <= 20 min on 2 cores",
        minutes <= 20.0 and result.verdict.outcome in ("found", "nothing_found"),
        COMMAND,
        f"{result.verdict.outcome}; 2 options instead of questions (car, limit), {PHOTOGRAPHS} pictures, budget {options.budget}{effect}",
    )
    off, mean_m, low_m, high_m = there[FOUND]
    record_row(
        "what that audit found, driven past in the place itself: starts off the lane",
        off,
        f"of {STARTS}",
        "listed beside the audit's own interval",
        None,
        COMMAND,
        f"the lab's own car; largest deviation {mean_m:+.2f} m over no object (95 % {low_m:.2f} to {high_m:.2f}), predicted in the copy "
        + (
            "nothing"
            if judged is None
            else f"{judged.effect.mean_m:+.2f} m ({judged.effect.low_m:.2f} to {judged.effect.high_m:.2f})"
        )
        + f"; past a plain panel {there[PLAIN_OBJECT][0]} of {STARTS}, past none {there[NO_OBJECT][0]}",
    )


if __name__ == "__main__":
    main()
