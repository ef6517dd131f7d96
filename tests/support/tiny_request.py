"""The smallest complete request: a real scene file (of empty space), a real policy file, the simulated lab's calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene
from calibration.schema import CameraCalibration, load_calibration
from nodes.experiment.node.prepare import load_request

if TYPE_CHECKING:
    from advnerf_core.attack.search.record import Evaluation
    from nodes.experiment.show.context import Experiment

CALIBRATION = Path(__file__).parents[2] / "calibration" / "twin"

TEXT = """\
name: tiny
world: {{kind: scene, file: scene.safetensors, calibration: {calibration}}}
paths: [track]
victims: {{mine: {{policy: policy.safetensors}}}}
objects:
  - {{name: board, kind: panel, x_m: 1.2, y_m: -1.7, z_m: -0.1, yaw_rad: 3.1, face: {{size_m: 1.0, resolution: 8, rgb: [0.2, 0.62, 0.28], target: {calibration}/board.yaml}}}}
horizon: 3
held_cap_m: 1.5
attack: {{evaluations: {evaluations}, cache_mib: 8}}
over: {{method: [gradient], seed: [0]}}
deploy: {{through: nothing}}
gate: null
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
    file = folder / "tiny.experiment.yaml"
    file.write_text(TEXT.format(calibration=CALIBRATION, evaluations=evaluations))
    return file


class StoppedError(Exception):
    """A search was stopped."""


def stop_at_one(evaluation: Evaluation) -> None:
    """Stop a search after its second evaluation."""
    if evaluation.iteration == 1:
        raise StoppedError


def with_objects(file: Path, *objects: str, rest: str = "") -> Path:
    """Give a tiny request other objects, each in YAML's short form, and more keys; the same file."""
    lines = file.read_text().splitlines()
    first = lines.index("objects:")
    lines[first : first + 2] = ["objects:", *(f"  - {text}" for text in objects), rest]
    file.write_text("\n".join(lines) + "\n")
    return file


def loaded(file: Path, changes: Sequence[str] = ()) -> Experiment:
    """The request of a file; what is kept of it lies beside the file."""
    return load_request(file, changes, file.parent / "run")
