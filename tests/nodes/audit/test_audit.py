"""Whole audits by the command, of policies whose truth is known, in a place that is known by photographs of a drive in a circle."""

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.documents import read_json
from advnerf_core.geometry import make_transform, planar_pose, rotation_z
from advnerf_core.report.audit_result import read_audit
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.audit.kept import AuditDiffersError, check_audit

pytestmark = pytest.mark.slow  # a learned place and a dozen searches each
PHOTOGRAPHS, RADIUS_M, WHEELBASE_M, LIMIT_M = 48, 1.2, 0.25, 0.25
T_IMAGES_FROM_LAB = make_transform(rotation_z(0.5), [3.0, -2.0, 1.2])
CAR = f"car: {{speed_mps: 0.8, wheelbase_m: {WHEELBASE_M}, max_steering_rad: 0.35}}\ncamera_ahead_m: 0.3\ncamera_height_m: 0.2\n"
# All of them drive round the circle: it is held by the steering alone, as in the open air.
POLICIES = """
import torch
from advnerf_core import PolicyContract, PolicyView, adapt
from hardware.worlds.lab.config import LabConfig

class Driver(torch.nn.Module):
    def __init__(self, steering_rad, gain_rad):
        super().__init__()
        self.steering_rad, self.gain_rad = steering_rad, gain_rad

    def forward(self, images):
        red = (images[:, 0] - torch.maximum(images[:, 1], images[:, 2]) - 0.2).clamp(min=0.0)
        return self.steering_rad + self.gain_rad * red.mean(dim=(1, 2))

def driver(steering_rad, gain_rad):
    view = PolicyView(LabConfig().camera.pinhole, width=100, height=33)
    return adapt(Driver(steering_rad, gain_rad).eval(), PolicyContract(view))

def blind():
    return driver(STEERING_RAD, 0.0)

def seduced():
    return driver(STEERING_RAD, 8.0)

def astray():
    return driver(0.0, 0.0)

def biased():
    return driver(STEERING_RAD + 0.03, 8.0)
""".replace("STEERING_RAD", repr(math.atan(WHEELBASE_M / RADIUS_M)))
QUICK = [
    "scene={steps: 80, log2_entries: 12, levels: 4, finest: 64, occupancy: 32}", "horizon=30", "capture.held_out=4",
    "object.panel_resolution=16",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: photographs of a lap in a frame of their own, a car, policies; ``learned`` is what the first audit leaves."""
    found = tmp_path_factory.mktemp("user")
    with Lab(LabConfig()) as lab:
        turns = 2.0 * np.pi * np.arange(PHOTOGRAPHS) / PHOTOGRAPHS
        states = [(RADIUS_M * math.sin(turn), -RADIUS_M * math.cos(turn), turn) for turn in turns.tolist()]
        write_posed_images(
            found / "photos",
            [T_IMAGES_FROM_LAB @ planar_pose(*state) @ lab.T_car_from_camera for state in states],
            lab.camera_pinhole,
            lambda index: lab.observe_at(*states[index], depth=False)[0],
            "png",
        )
    (found / "car.yaml").write_text(CAR)
    (found / "drivers.py").write_text(POLICIES)
    return found


def audit(folder: Path, name: str, *options: str, output: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command in the user's folder; what an earlier audit has learned of the place is taken over."""
    target, learned = folder / (output or name), folder / "seduced"
    for half in ("half", "other-half"):
        if learned.exists() and target != learned and not (target / half).exists():
            shutil.copytree(learned / half, target / half)
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "audit",
        f"drivers:{name}",
        "--place",
        "photos",
        "-o",
        str(target),
    ]
    words = [
        "--car",
        "car.yaml",
        "--limit",
        str(LIMIT_M),
        "--evaluations",
        "60",
        "--starts",
        "8",
        "--size",
        "0.5",
    ]
    changes = [word for each in QUICK for word in ("--set", each)]
    environment = {**os.environ, "PYTHONPATH": f"{Path(__file__).parents[3]}{os.pathsep}{folder}"}
    return subprocess.run(
        [*command, *words, *changes, *options],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
        stdin=subprocess.DEVNULL,
    )


@pytest.fixture(scope="module")
def seduced(folder: Path) -> subprocess.CompletedProcess[str]:
    return audit(folder, "seduced", "--harden", "--ci")


def test_a_policy_that_red_leads_astray_is_found_and_the_numbers_are_those_of_the_drives(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    assert seduced.returncode == 1, seduced.stdout + seduced.stderr
    result = read_audit(folder / "seduced" / "audit.json")
    assert result.verdict.evidence == "surrogate"
    assert "not driven" in result.verdict.sentence
    assert result.fidelity is not None
    assert result.fidelity.halves_agree
    assert {each.kind: each.off_track for each in result.controls} == {
        "no_object": 0,
        "plain_object": 0,
        "natural_picture": 0,
    }
    assert result.strongest is not None
    assert (folder / "seduced" / result.strongest.object.texture).is_file()
    assert check_audit(folder / "seduced")
    page = (folder / "seduced" / "audit.html").read_text()
    assert page.index(result.verdict.sentence) < page.index("<video") < page.index("<svg")


def test_a_changed_number_is_noticed(
    folder: Path, seduced: subprocess.CompletedProcess[str], tmp_path: Path
) -> None:
    for name in ("audit.json", "drives.json"):
        shutil.copy(folder / "seduced" / name, tmp_path / name)
    data: dict[str, Any] = read_json(tmp_path / "audit.json")
    data["strongest"]["judgements"][0]["effect"]["low_m"] -= 0.01
    (tmp_path / "audit.json").write_text(json.dumps(data))
    with pytest.raises(AuditDiffersError, match=r"effect\.low_m: expected"):
        check_audit(tmp_path)


def test_a_second_run_gives_the_same_bytes(folder: Path, seduced: subprocess.CompletedProcess[str]) -> None:
    before = (folder / "seduced" / "audit.json").read_bytes()
    again = audit(folder, "seduced", "--ci")
    assert again.returncode == seduced.returncode
    assert (folder / "seduced" / "audit.json").read_bytes() == before


def test_exported_frames_are_labelled_with_steering_back_to_the_path(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    rows = (folder / "seduced" / "harden" / "labels.csv").read_text().splitlines()
    columns = rows[0].split(",")
    labels = [dict(zip(columns, row.split(","), strict=True)) for row in rows[1:]]
    assert all((folder / "seduced" / "harden" / each["image"]).is_file() for each in labels)
    held = math.atan(WHEELBASE_M / RADIUS_M)
    off = [each for each in labels if abs(float(each["cte_m"])) > 0.15]
    assert off
    assert all((float(each["steering"]) - held) * float(each["cte_m"]) < 0.0 for each in off)


def test_a_blind_policy_is_cleared_once_a_planted_weakness_was_found(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    found = audit(folder, "blind")
    assert found.returncode == 0, found.stdout + found.stderr
    result = read_audit(folder / "blind" / "audit.json")
    assert result.planted is not None
    assert result.planted.found
    assert "no object was found within this budget" in result.verdict.sentence


def test_a_policy_that_does_not_drive_is_not_judged(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    found = audit(folder, "astray")
    assert found.returncode == 2, found.stdout + found.stderr
    assert "does not drive here: without any object it leaves its lane from 4 of 4 starts" in found.stdout


def test_a_biased_policy_is_worse_than_before_and_an_unchanged_one_is_not(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    against = ("--against", "seduced/audit.json")
    assert audit(folder, "seduced", *against, output="again").returncode == 1
    found = audit(folder, "biased", *against)
    assert found.returncode == 3, found.stdout + found.stderr
    assert "The policy is worse than in seduced/audit.json" in found.stdout


def test_without_a_terminal_a_question_names_its_option(folder: Path) -> None:
    found = audit(folder, "blind", "--car", "racecarj", output="asked")
    assert found.returncode == 2
    assert "expected --camera-height, as no terminal can be asked" in found.stderr


def test_another_question_in_the_same_folder_is_refused(
    folder: Path, seduced: subprocess.CompletedProcess[str]
) -> None:
    found = audit(folder, "blind", output="seduced")
    assert found.returncode == 64
    assert "expected a folder of this audit or a new one" in found.stderr
