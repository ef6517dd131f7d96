"""Stage scene: learn the world from its photographs, and compare with held-out views of the driving camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.scene.colour import ColourMap, fit_colour_map
from advnerf_core.scene.field import SceneFieldConfig, save_scene
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, TrainedScene, TrainingReport, train_scene
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import captured, compare_views, scene_file
from nodes.experiment.steps import capture
from nodes.runtime.progress import MeasuringReport, Point

_TRAINING_SHARE = 0.97


def run(experiment: Experiment, folder: Path, report: MeasuringReport) -> None:
    """Write ``scene.safetensors``, and ``fidelity.json`` with pictures of true and learned views."""
    config = experiment.config.scene
    photographs = captured(experiment, capture.PHOTOS).load()

    def progress(at: TrainingReport) -> None:
        text = f"step {at.step}, {at.psnr_db:.1f} dB on training rays"
        report(_TRAINING_SHARE * at.fraction, text, Point("PSNR on training rays [dB]", at.step, at.psnr_db))

    field = field_config(experiment)
    march = pixel_intervals(
        [experiment.view.pinhole], photographs.T_world_from_camera, field, config.near_m, config.interval_px
    )
    training = TrainConfig(
        steps=config.steps,
        seed=config.seed,
        march=march,
        refine_depth=config.refine_depth,
        occupancy_resolution=config.occupancy,
        decay=config.decay,
        learning_rate=config.learning_rate,
        exposure=config.exposure,
    )
    checkpoint = folder / "checkpoint.safetensors"
    trained = train_scene(photographs, field, training, checkpoint, progress)
    metadata: dict[str, Any] = {
        "march": vars(trained.march),
        "steps": config.steps,
        "seed": config.seed,
        "photographs": len(photographs.rgb),
    }
    if experiment.config.capture.colour_pairs:
        report(_TRAINING_SHARE, "fitting the colour map")
        metadata["colour_map"] = _colour_map(experiment, trained).to_dict()
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    compare_views(experiment, _TRAINING_SHARE, report)
    checkpoint.unlink(missing_ok=True)


def _colour_map(experiment: Experiment, trained: TrainedScene) -> ColourMap:
    """Map from the photographs' colours to the driving camera's, fitted to views of the same places."""
    pairs = captured(experiment, capture.COLOUR_PAIRS).load()
    bare = FieldRenderer(trained.scene, trained.occupied, trained.march)
    return fit_colour_map(render_like(bare, pairs), pairs.rgb)


def render_like(renderer: FieldRenderer, views: ImageSet) -> NDArray[np.float32]:
    """Render every view of an image set at its own pose and size, ``[N, H, W, 3]`` in 0..1."""
    pairs = zip(views.T_world_from_camera, views.pinholes, strict=True)
    return torch.cat([renderer.render(pose[None], pinhole)[0] for pose, pinhole in pairs]).numpy()


def field_config(experiment: Experiment) -> SceneFieldConfig:
    """A field in the world's box: a little larger if it holds everything, unchanged if the outside is contracted."""
    wanted, box = experiment.config.scene, experiment.world.box
    grid = HashGridConfig(
        levels=wanted.levels, features=4, log2_entries=wanted.log2_entries, finest=wanted.finest
    )
    margin_m = 0.0 if box.contraction else wanted.margin_m
    low = (box.min_m[0] - margin_m, box.min_m[1] - margin_m, box.min_m[2] - margin_m)
    high = (box.max_m[0] + margin_m, box.max_m[1] + margin_m, box.max_m[2] + margin_m)
    return SceneFieldConfig(low, high, grid, contraction=box.contraction)
