"""Stage scene: learn the world from its photographs, and compare with held-out views of the driving camera."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.data.dataset import load_transforms
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.scene.field import SceneFieldConfig, save_scene
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.train import Progress, TrainConfig, train_scene
from nodes.experiment.junction import capture
from nodes.experiment.junction.context import Experiment
from nodes.experiment.learned_scene import compare_views, scene_file
from nodes.runtime.progress import Report

_TRAINING_SHARE = 0.97


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``scene.safetensors``, and ``fidelity.json`` with pictures of true and learned views."""
    config = experiment.config.scene
    photographs = load_transforms(
        experiment.stage_folder("capture") / capture.PHOTOS, require_all=True
    ).load()

    def progress(at: Progress) -> None:
        report(_TRAINING_SHARE * at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays")

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
    )
    checkpoint = folder / "checkpoint.safetensors"
    trained = train_scene(photographs, field, training, checkpoint, progress)
    metadata = {
        "march": vars(trained.march),
        "steps": config.steps,
        "seed": config.seed,
        "photographs": len(photographs.rgb),
    }
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    compare_views(experiment, experiment.view, _TRAINING_SHARE, report)
    checkpoint.unlink(missing_ok=True)


def field_config(experiment: Experiment) -> SceneFieldConfig:
    """A field in the world's box: a little larger than that if it holds everything, as it is if what lies outside is contracted."""
    wanted, box = experiment.config.scene, experiment.world.box
    grid = HashGridConfig(
        levels=wanted.levels, features=4, log2_entries=wanted.log2_entries, finest=wanted.finest
    )
    margin_m = 0.0 if box.contraction else wanted.margin_m
    low = (box.min_m[0] - margin_m, box.min_m[1] - margin_m, box.min_m[2] - margin_m)
    high = (box.max_m[0] + margin_m, box.max_m[1] + margin_m, box.max_m[2] + margin_m)
    return SceneFieldConfig(low, high, grid, contraction=box.contraction)
