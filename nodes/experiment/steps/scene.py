"""Stage scene: learn the world from its photographs, and compare with held-out views of the driving camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.scene.colour import fit_colour_map
from advnerf_core.scene.field import SceneFieldConfig, save_scene
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, TrainingReport, train_scene
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
        # To the driving camera's colours, fitted to views of the same places.
        pairs = captured(experiment, capture.COLOUR_PAIRS).load()
        bare = FieldRenderer(trained.scene, trained.occupied, trained.march)
        seen = zip(pairs.T_world_from_camera, pairs.pinholes, strict=True)
        learned = torch.cat([bare.render(pose[None], pinhole)[0] for pose, pinhole in seen]).numpy()
        metadata["colour_map"] = fit_colour_map(learned, pairs.rgb).to_dict()
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    compare_views(experiment, _TRAINING_SHARE, report)
    checkpoint.unlink(missing_ok=True)


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
