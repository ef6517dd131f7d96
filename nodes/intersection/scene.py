"""Stage scene: learn the junction from its photographs, and compare with held-out views of the driving camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.files import write_atomically
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.dataset import load_transforms
from advnerf_core.scene.field import SceneFieldConfig, load_scene, save_scene
from advnerf_core.scene.metrics import psnr, ssim
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import Progress, TrainConfig, train_scene
from nodes.intersection import capture
from nodes.intersection.context import Experiment
from nodes.runtime.stages import Report

# A junction is ten times a room: so are the first and the longest intervals between samples.
_MARCH = MarchConfig(near_m=0.3, smallest_step_m=0.03, largest_step_m=0.8, step_growth=0.016)
_TRAINING_SHARE = 0.97


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``scene.safetensors``, and ``fidelity.json`` with pictures of true and learned views."""
    config = experiment.config.scene
    photographs = load_transforms(experiment.stage_folder("capture") / capture.PHOTOS, require_all=True).load()

    def progress(at: Progress) -> None:
        report(_TRAINING_SHARE * at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays")

    training = TrainConfig(
        steps=config.steps, seed=config.seed, march=_MARCH, refine_depth=config.refine_depth,
        occupancy_resolution=config.occupancy,
    )  # fmt: skip
    checkpoint = folder / "checkpoint.safetensors"
    trained = train_scene(photographs, field_config(experiment), training, checkpoint, progress)
    metadata = {
        "march": vars(trained.march), "steps": config.steps, "seed": config.seed, "photographs": len(photographs.rgb),
    }  # fmt: skip
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    _compare(experiment, folder, FieldRenderer.from_file(scene_file(experiment)), report)
    checkpoint.unlink(missing_ok=True)


def field_config(experiment: Experiment) -> SceneFieldConfig:
    """A field in a box around the world, its painted sky included: nothing lies outside."""
    wanted, road = experiment.config.scene, experiment.world.road
    half = road.half_m + wanted.margin_m
    grid = HashGridConfig(levels=wanted.levels, features=4, log2_entries=wanted.log2_entries, finest=wanted.finest)
    low, high = (-half, -half, -wanted.margin_m), (half, half, road.sky_m + wanted.margin_m)
    return SceneFieldConfig(low, high, grid)


def scene_file(experiment: Experiment) -> Path:
    """Where the trained scene is."""
    return experiment.stage_folder("scene") / "scene.safetensors"


def load_background(experiment: Experiment) -> FieldRenderer:
    """The trained scene."""
    return FieldRenderer.from_file(scene_file(experiment))


def scene_sha256(experiment: Experiment) -> str:
    """Content hash of the trained scene."""
    return str(load_scene(scene_file(experiment))[2]["scene_hash"])


def _compare(experiment: Experiment, folder: Path, renderer: FieldRenderer, report: Report) -> None:
    """PSNR and SSIM at the camera's size and at the policy's: there the field's own render against the resized image."""
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
            capture.write_image(path, image)
            row[f"{name}_image"] = str(path.relative_to(experiment.folder))
        rows.append(row)
    means = {key: float(np.mean([row[key] for row in rows])) for key in ("psnr_full_db", "psnr_policy_db")}
    write_atomically(folder / "fidelity.json", json.dumps({"mean": means, "views": rows}, indent=1) + "\n")
