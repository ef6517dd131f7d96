"""``advnerf audit`` as a new user runs it: an own ONNX policy, pictures of a drive, and what the place itself says of the verdict.

The pictures are rendered in the simulated lab, which the command does not know: it is given their folder or their video alone. What it finds in
its learned copies is then driven past in the lab, by the lab's own car, from 50 starts of their own.

    python -m benchmarks.own_place [--budget 15m | --ci]         # posed photographs
    python -m benchmarks.own_place --through video               # a video, whose poses are estimated, and a few measured places
    python -m benchmarks.own_place --through driver              # the policy behind a socket, as `advnerf policy serve` offers it
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.geometry import planar_pose
from advnerf_core.policies.adapter import adapted
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import load_any_policy
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.report.audit_result import AuditResult, read_audit
from advnerf_core.report.clips import write_video
from benchmarks.results import REPOSITORY, record_row
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.paths import Pose
from nodes.audit.comparing import ATTACK_KEPT
from nodes.audit.drives import FOUND, NO_OBJECT, PLAIN_OBJECT, arm_of, driven, with_starts
from nodes.audit.images import IMPORTED, POSES
from nodes.audit.kept import check_audit
from nodes.audit.learning import OTHER_HALF
from nodes.audit.question import FILE
from nodes.audit.verdict import effect_of
from nodes.experiment.steps.run import load_experiment
from tests.support.lab_photographs import photograph

COMMAND = "python -m benchmarks.own_place"
VICTIM_FILE = REPOSITORY / "docs/results/reference/policy_722ab9106e2fbad0/policy.safetensors"
PHOTOGRAPHS, LIMIT_M, STARTS, SEED = 160, 0.4, 50, 30_000
# How a person drives: off the line and turned by this much, several times a lap.
_WOBBLE_M, _TURNED_RAD = 0.05, 0.08
POLICY, PHOTOS, VIDEO = "my_policy.onnx", "photos", "drive.mp4"
OPTIONS = ("--car", "my_car.yaml", "--limit", str(LIMIT_M))
_VIDEO_FRAMES, _ASKED = 600, 2
_MEASURED = 8  # places of the camera that the user measures, to a centimetre
_WHAT = {
    "photographs": "an own ONNX policy in photographs of an own drive",
    "video": "an own ONNX policy in a video of an own drive",
    "driver": "a driver behind a socket in photographs of an own drive",
}
_FEW = ("--evaluations", "12", "--starts", "8")
_SPEED_MPS, _WHEELBASE_M = 0.8, 0.25
_CAR = f"car: {{speed_mps: {_SPEED_MPS}, wheelbase_m: {_WHEELBASE_M}, max_steering_rad: 0.26}}\ncamera_ahead_m: 0.3\ncamera_height_m: 0.2\n"


def make_folder(folder: Path) -> None:
    """A lap by hand, photographed by the driving camera, beside the policy and the car."""
    with Lab(LabConfig()) as lab:
        photograph(lab, lap(lab, PHOTOGRAPHS), folder / PHOTOS)
    write_policy_and_car(folder)


def make_video(folder: Path) -> tuple[str, ...]:
    """The same as a video, whose poses an audit estimates before it asks for a length; returns the option that answers."""
    write_policy_and_car(folder)
    with Lab(LabConfig()) as lab:
        states = lap(lab, _VIDEO_FRAMES)
        write_video(folder / VIDEO, [lab.observe_at(*state, depth=False)[0] for state in states])
        at_m = [(planar_pose(*state) @ lab.T_car_from_camera)[:3, 3] for state in states]
    ended = audit(folder, "audit", POLICY, "--place", VIDEO, *OPTIONS)
    assert ended.returncode == _ASKED, f"it did not ask for a length, but ended with {ended.returncode}"
    names = [each["file_path"] for each in read_json(folder / "audit" / IMPORTED / POSES)["frames"]]
    lines = ["image,x_m,y_m,z_m"]
    for name in names[:: max(1, len(names) // _MEASURED)]:
        lines.append(",".join([name, *(f"{each:.2f}" for each in at_m[int(Path(name).stem)])]))
    (folder / "measured.csv").write_text("\n".join(lines) + "\n")
    return "--positions", "measured.csv"


def lap(lab: Lab, count: int) -> list[Pose]:
    """Poses of the car on a lap by hand."""
    path, states = lab.describe().paths["track"], []
    for share in np.arange(count) / count:
        x, y, yaw = path.pose_at(path.length_m * share)
        off_m = _WOBBLE_M * np.sin(18 * np.pi * share)
        turned = yaw + _TURNED_RAD * np.cos(14 * np.pi * share)
        states.append((x - off_m * np.sin(yaw), y + off_m * np.cos(yaw), turned))
    return states


def write_policy_and_car(folder: Path) -> None:
    """An ONNX file, and the car that it drives."""
    loaded = load_any_policy(VICTIM_FILE)
    policy = adapted(loaded.policy, PolicyContract(loaded.view))
    export_onnx(policy.network, policy.contract, folder / POLICY)
    (folder / "my_car.yaml").write_text(_CAR)


def run_audit(folder: Path, output: str, *words: str) -> tuple[AuditResult, float]:
    """``advnerf audit`` in a user's folder: its result, checked against its drives, and how long it took [min]."""
    began = time.monotonic()
    ended = audit(folder, output, *words)
    minutes = (time.monotonic() - began) / 60.0
    result = read_audit(folder / output / "audit.json")
    assert ended.returncode == result.exit_code, f"the command ended with {ended.returncode}"
    print("\n".join(check_audit(folder / output)))
    return result, minutes


def audit(folder: Path, output: str, *words: str) -> subprocess.CompletedProcess[bytes]:
    """The command in a user's folder."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "nodes.cli", "audit", *words, "-o", output]
    return subprocess.run(command, cwd=folder, env=environment, check=False)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The policy behind a socket: its address."""
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "policy",
        "serve",
        str(folder / POLICY),
        "--listen",
        "127.0.0.1:0",
    ]
    car = ("--wheelbase", str(_WHEELBASE_M), "--speed", str(_SPEED_MPS))
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen([*command, *car], stdout=subprocess.PIPE, text=True, env=environment) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().split()[3].rstrip(";")
        finally:
            server.terminate()


def run_small(folder: Path) -> None:
    """The setting for continuous integration, twice: how long it takes, and whether it says the same."""
    (result, first), (_, second) = (
        run_audit(folder, name, POLICY, "--place", PHOTOS, "--in-metres", *OPTIONS, "--ci")
        for name in ("one", "two")
    )
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
            name: driven(experiment, arm_of(experiment, name, attack), lab)
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
    parser.add_argument("--through", choices=tuple(_WHAT), default="photographs", help="what the user has")
    parser.add_argument("--ci", action="store_true", help="measure the small setting instead")
    options = parser.parse_args()
    command = COMMAND + f" --through {options.through}" * (options.through != "photographs")
    command += f" --budget {options.budget}" * (options.budget != parser.get_default("budget"))
    # A driver takes whole pictures of its camera: each of its drives takes many times as long.
    effort = _FEW if options.through == "driver" else ("--budget", options.budget)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.through == "video":
            words = (POLICY, "--place", VIDEO, *OPTIONS, *make_video(folder))
        else:
            make_folder(folder)
            words = (POLICY, "--place", PHOTOS, "--in-metres", *OPTIONS)
        if options.ci:
            run_small(folder)
            return
        with served(folder) if options.through == "driver" else nullcontext(POLICY) as policy:
            result, minutes = run_audit(folder, "audit", policy, *words[1:], *effort)
            there = drive_in_the_lab(folder) if result.strongest is not None else {}
    record(command, _WHAT[options.through], result, minutes, effort)
    if there:
        record_drives(command, _WHAT[options.through], result, there)


def record(command: str, what: str, result: AuditResult, minutes: float, effort: tuple[str, ...]) -> None:
    """The row of the audit."""
    judged = result.judgement
    effect = (
        ""
        if judged is None
        else f"; {judged.off_track} of {len(judged.starts)} starts off the lane in the copy"
    )
    record_row(
        f"audit of {what}: from nothing to the verdict",
        round(minutes, 1),
        "min",
        "one command, <= 3 questions, <= 20 min on 2 cores",
        minutes <= 20.0 and result.verdict.outcome in ("found", "nothing_found"),
        command,
        f"{result.verdict.outcome}; options instead of questions, {' '.join(effort)}{effect}",
    )


def record_drives(
    command: str, what: str, result: AuditResult, there: dict[str, tuple[int, float, float, float]]
) -> None:
    """The row of the drives in the place itself."""
    judged = result.judgement
    off, mean_m, low_m, high_m = there[FOUND]
    predicted = (
        "nothing"
        if judged is None
        else f"{judged.effect.mean_m:+.2f} m ({judged.effect.low_m:.2f} to {judged.effect.high_m:.2f})"
    )
    record_row(
        f"what the audit of {what} found, driven past in the place itself: starts off the lane",
        off,
        f"of {STARTS}",
        "listed beside the audit's own interval",
        None,
        command,
        f"the lab's own car; largest deviation {mean_m:+.2f} m over no object (95 % {low_m:.2f} to {high_m:.2f}), predicted in the copy {predicted}"
        f"; past a plain panel {there[PLAIN_OBJECT][0]} of {STARTS}, past none {there[NO_OBJECT][0]}",
    )


if __name__ == "__main__":
    main()
