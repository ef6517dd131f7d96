"""Stage scene: learn the room from the phone's photographs, and compare with held-out views of the driving camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from advnerf_core.scene.colour import fit_colour_map
from advnerf_core.scene.dataset import ImageSet, load_transforms
from advnerf_core.scene.field import SceneFieldConfig, load_scene, save_scene
from advnerf_core.scene.metrics import psnr, ssim
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import Progress, TrainConfig, train_scene
from nodes.experiment import capture
from nodes.experiment.context import Experiment
from nodes.runtime.stages import Report

_TRAINING_SHARE = 0.95


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``scene.safetensors`` with its colour map, and ``fidelity.json`` with pictures of real and learned views."""
    config, captured = experiment.config.scene, experiment.stage_folder("capture")
    photographs = load_transforms(captured / capture.PHONE, require_all=True).load()

    def progress(at: Progress) -> None:
        report(_TRAINING_SHARE * at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays")

    trained = train_scene(
        photographs, _field_config(experiment), TrainConfig(steps=config.steps, seed=config.seed),
        folder / "checkpoint.safetensors", progress,
    )  # fmt: skip
    report(_TRAINING_SHARE, "fitting the colour map")
    pairs = load_transforms(captured / capture.COLOUR_PAIRS, require_all=True).load()
    bare = FieldRenderer(trained.scene, trained.occupied, trained.march)
    colour_map = fit_colour_map(render_like(bare, pairs), pairs.rgb)
    metadata = {
        "march": vars(trained.march), "colour_map": colour_map.to_dict(), "steps": config.steps, "seed": config.seed,
        "photographs": len(photographs.rgb),
    }  # fmt: skip
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    _compare(experiment, folder, FieldRenderer.from_file(scene_file(experiment)), report)
    (folder / "checkpoint.safetensors").unlink(missing_ok=True)


def scene_file(experiment: Experiment) -> Path:
    """Where the trained scene is."""
    return experiment.stage_folder("scene") / "scene.safetensors"


def load_background(experiment: Experiment) -> FieldRenderer:
    """The trained scene in the colours of the driving camera."""
    return FieldRenderer.from_file(scene_file(experiment))


def scene_sha256(experiment: Experiment) -> str:
    """Content hash of the trained scene."""
    return str(load_scene(scene_file(experiment))[2]["scene_hash"])


def render_like(renderer: FieldRenderer, views: ImageSet) -> NDArray[np.float32]:
    """Render every view of an image set at its own pose and size, ``[N, H, W, 3]`` in 0..1."""
    pairs = zip(views.T_world_from_camera, views.pinholes, strict=True)
    return torch.cat([renderer.render(pose[None], pinhole)[0] for pose, pinhole in pairs]).numpy()


def _field_config(experiment: Experiment) -> SceneFieldConfig:
    room, margin_m = experiment.lab_config.room, experiment.config.scene.margin_m
    half = 0.5 * room.side_m + margin_m
    return SceneFieldConfig((-half, -half, -margin_m), (half, half, room.height_m + margin_m))


def _compare(experiment: Experiment, folder: Path, renderer: FieldRenderer, report: Report) -> None:
    """PSNR and SSIM at the camera's size and at the policy's: there the surrogate's own render against the resized image."""
    listed = load_transforms(experiment.stage_folder("capture") / capture.HELD_OUT, require_all=True)
    views, rows = listed.load(), []
    for index, (real, pose) in enumerate(zip(views.rgb, views.T_world_from_camera, strict=True)):
        report(_TRAINING_SHARE + (1 - _TRAINING_SHARE) * index / len(views.rgb), f"held-out view {index + 1}")
        full = renderer.render(pose[None], views.pinholes[index])[0][0].numpy()
        small = renderer.render(pose[None], experiment.view.pinhole)[0][0].numpy()
        seen = experiment.view.image(real)
        row: dict[str, Any] = {
            "label": listed.frames[index].path.name, "psnr_full_db": psnr(full, real / 255.0),
            "psnr_policy_db": psnr(small, seen / 255.0), "ssim_full": ssim(full, real / 255.0),
            "ssim_policy": ssim(small, seen / 255.0),
        }  # fmt: skip
        for name, image in (("real", real), ("surrogate", np.round(255 * full).astype(np.uint8))):
            path = folder / "views" / f"{index:03d}_{name}.png"
            write_atomically(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())
            row[f"{name}_image"] = str(path.relative_to(experiment.folder))
        rows.append(row)
    means = {key: float(np.mean([row[key] for row in rows])) for key in ("psnr_full_db", "psnr_policy_db")}
    write_atomically(folder / "fidelity.json", json.dumps({"mean": means, "views": rows}, indent=1) + "\n")
