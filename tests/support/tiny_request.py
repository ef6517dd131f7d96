"""The smallest complete request: a real scene file (of empty space), a real policy file, the simulated lab's calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene
from calibration.schema import CameraCalibration, load_calibration

CALIBRATION = Path(__file__).parents[2] / "calibration" / "twin"

TEXT = """\
name: tiny
scene: scene.safetensors
policy: policy.safetensors
calibration: {calibration}
objects:
  - {{x_m: 1.2, y_m: -1.7, z_m: 0.4, yaw_rad: 3.1, size_m: 1.0, resolution: 8, target: {calibration}/board.yaml}}
horizon: 3
search: {{evaluations: {evaluations}, seeds: [0], cache_mib: 8}}
"""


def tiny_request(folder: Path, evaluations: int = 3) -> Path:
    """Write everything a request needs; the request file."""
    folder.mkdir(parents=True, exist_ok=True)
    grid = HashGridConfig(levels=2, features=2, log2_entries=8, coarsest=4, finest=8)
    scene = SceneField(SceneFieldConfig((-4.0, -4.0, 0.0), (4.0, 4.0, 2.5), grid=grid, hidden=16))
    save_scene(folder / "scene.safetensors", scene, np.zeros((4, 4, 4), bool), {})
    torch.manual_seed(0)
    camera = load_calibration(CameraCalibration, CALIBRATION / "camera.yaml")
    save_policy(folder / "policy.safetensors", PilotNet().eval(), PolicyView(camera.pinhole), {})
    file = folder / "tiny.attack.yaml"
    file.write_text(TEXT.format(calibration=CALIBRATION, evaluations=evaluations))
    return file
