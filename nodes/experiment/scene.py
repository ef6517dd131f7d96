"""Stage scene: learn the room from the phone's photographs, and compare with held-out views of the driving camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.data.dataset import ImageSet, load_transforms
from advnerf_core.scene.colour import fit_colour_map
from advnerf_core.scene.field import SceneFieldConfig, save_scene
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import Progress, TrainConfig, train_scene
from nodes.experiment import capture
from nodes.experiment.context import Experiment
from nodes.experiment.learned_scene import compare_views, scene_file
from nodes.runtime.progress import Report

_TRAINING_SHARE = 0.95


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``scene.safetensors`` with its colour map, and ``fidelity.json`` with pictures of real and learned views."""
    config, captured = experiment.config.scene, experiment.stage_folder("capture")
    photographs = load_transforms(captured / capture.PHONE, require_all=True).load()

    def progress(at: Progress) -> None:
        report(_TRAINING_SHARE * at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays")

    field = _field_config(experiment)
    # The policy's view is coarser than the phone's: samples as fine as the phone's pixels would cost time in every tick.
    march = pixel_intervals(
        [experiment.view.pinhole], photographs.T_world_from_camera, field, interval_px=config.interval_px
    )
    training = TrainConfig(steps=config.steps, seed=config.seed, march=march)
    trained = train_scene(photographs, field, training, folder / "checkpoint.safetensors", progress)
    report(_TRAINING_SHARE, "fitting the colour map")
    pairs = load_transforms(captured / capture.COLOUR_PAIRS, require_all=True).load()
    bare = FieldRenderer(trained.scene, trained.occupied, trained.march)
    colour_map = fit_colour_map(render_like(bare, pairs), pairs.rgb)
    metadata = {
        "march": vars(trained.march),
        "colour_map": colour_map.to_dict(),
        "steps": config.steps,
        "seed": config.seed,
        "photographs": len(photographs.rgb),
    }
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    compare_views(experiment, experiment.view, _TRAINING_SHARE, report)
    (folder / "checkpoint.safetensors").unlink(missing_ok=True)


def render_like(renderer: FieldRenderer, views: ImageSet) -> NDArray[np.float32]:
    """Render every view of an image set at its own pose and size, ``[N, H, W, 3]`` in 0..1."""
    pairs = zip(views.T_world_from_camera, views.pinholes, strict=True)
    return torch.cat([renderer.render(pose[None], pinhole)[0] for pose, pinhole in pairs]).numpy()


def _field_config(experiment: Experiment) -> SceneFieldConfig:
    room, margin_m = experiment.lab_config.room, experiment.config.scene.margin_m
    half = 0.5 * room.side_m + margin_m
    return SceneFieldConfig((-half, -half, -margin_m), (half, half, room.height_m + margin_m))
