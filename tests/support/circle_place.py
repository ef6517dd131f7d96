"""A user's folder with photographs of a drive in a circle, and policies whose answer to an audit is known."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from advnerf_core.geometry import make_transform, rotation_z
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from tests.support.lab_photographs import photograph

ROOT = Path(__file__).parents[2]
PHOTOGRAPHS, RADIUS_M, WHEELBASE_M, LIMIT_M = 48, 1.2, 0.25, 0.25
_T_IMAGES_FROM_LAB = make_transform(rotation_z(0.5), [3.0, -2.0, 1.2])
_CAR = f"car: {{speed_mps: 0.8, wheelbase_m: {WHEELBASE_M}, max_steering_rad: 0.35}}\ncamera_ahead_m: 0.3\ncamera_height_m: 0.2\n"
# All of them drive round the circle: it is held by the steering alone, as in the open air.
_POLICIES = """
import torch
from advnerf_core import PolicyContract, PolicyView, adapt
from hardware.worlds.lab.config import LabConfig

class Driver(torch.nn.Module):
    def __init__(self, steering_rad, gain_rad, channels=(0, 1, 2)):
        super().__init__()
        self.steering_rad, self.gain_rad, self.channels = steering_rad, gain_rad, list(channels)

    def forward(self, images):
        images = images[:, self.channels]
        red = (images[:, 0] - torch.maximum(images[:, 1], images[:, 2]) - 0.2).clamp(min=0.0)
        return self.steering_rad + self.gain_rad * red.mean(dim=(1, 2))

class Late(torch.nn.Module):
    def __init__(self, driver):
        super().__init__()
        self.driver = driver

    def initial_memory(self, batch):
        return torch.full((batch, 1), STEERING_RAD)

    def forward(self, images, goals, memory):
        return memory[:, 0], self.driver(images)[:, None]

def driver(steering_rad, gain_rad, **settings):
    view = PolicyView(LabConfig().camera.pinhole, width=100, height=33)
    return adapt(Driver(steering_rad, gain_rad, **settings).eval(), PolicyContract(view))

def blind():
    return driver(STEERING_RAD, 0.0)

def seduced():
    return driver(STEERING_RAD, 8.0)

def astray():
    return driver(0.0, 0.0)

def biased(by_rad=0.03):
    return driver(STEERING_RAD + by_rad, 8.0)

def swapped():
    return driver(STEERING_RAD, 8.0, channels=(2, 1, 0))

def late():
    view = PolicyView(LabConfig().camera.pinhole, width=100, height=33)
    return adapt(Late(Driver(STEERING_RAD, 8.0)).eval(), PolicyContract(view, stateless=False))
""".replace("STEERING_RAD", repr(math.atan(WHEELBASE_M / RADIUS_M)))
CHANGES = (
    "scene.steps=80", "scene.log2_entries=12", "scene.levels=4", "scene.finest=64", "scene.occupancy=32", "horizon=30", "capture.held_out=4",
    "object.panel_resolution=16",
)  # fmt: skip


def make_folder(folder: Path) -> None:
    """Write the photographs, in a frame of their own, the car and the policies."""
    with Lab(LabConfig()) as lab:
        turns = 2.0 * np.pi * np.arange(PHOTOGRAPHS) / PHOTOGRAPHS
        states = [(RADIUS_M * math.sin(turn), -RADIUS_M * math.cos(turn), turn) for turn in turns.tolist()]
        photograph(lab, states, folder / "photos", _T_IMAGES_FROM_LAB)
    (folder / "car.yaml").write_text(_CAR)
    (folder / "drivers.py").write_text(_POLICIES)


def command(policy: str, *options: str, output: str = "") -> list[str]:
    """The command that audits one of the policies, a file, or the driver at an address, run in their folder."""
    words = [
        "--place",
        "photos",
        "--in-metres",
        "-o",
        output or policy,
        "--car",
        "car.yaml",
        "--limit",
        str(LIMIT_M),
    ]
    words += ["--evaluations", "60", "--starts", "8", "--object-size", "0.5", "--in-metres"]
    changes = [word for each in CHANGES for word in ("--set", each)]
    return [
        sys.executable,
        "-m",
        "nodes.cli",
        "audit",
        policy if {".", "/"} & set(policy) else f"drivers:{policy}",
        *words,
        *changes,
        *options,
    ]


def environment(folder: Path) -> dict[str, str]:
    """In which a command finds this package and the policies."""
    return {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"}


def audit(folder: Path, policy: str, *options: str, output: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command in that folder for one of its policies."""
    return subprocess.run(
        command(policy, *options, output=output),
        cwd=folder, env=environment(folder), capture_output=True, text=True, timeout=1800, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
