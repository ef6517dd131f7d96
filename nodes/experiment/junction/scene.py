"""Stage scene: learn the junction from its photographs, and compare with held-out views of the driving camera."""

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

# Nothing stands nearer to the cameras.
_NEAR_M = 0.3
_TRAINING_SHARE = 0.97


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``scene.safetensors``, and ``fidelity.json`` with pictures of true and learned views."""
    config = experiment.config.scene
    photographs = load_transforms(experiment.stage_folder("capture") / capture.PHOTOS, require_all=True).load()

    def progress(at: Progress) -> None:
        report(_TRAINING_SHARE * at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays")

    field = field_config(experiment)
    march = pixel_intervals(
        [experiment.view.pinhole], photographs.T_world_from_camera, field, _NEAR_M, config.interval_px
    )
    training = TrainConfig(
        steps=config.steps, seed=config.seed, march=march, refine_depth=config.refine_depth,
        occupancy_resolution=config.occupancy,
    )  # fmt: skip
    checkpoint = folder / "checkpoint.safetensors"
    trained = train_scene(photographs, field, training, checkpoint, progress)
    metadata = {
        "march": vars(trained.march), "steps": config.steps, "seed": config.seed, "photographs": len(photographs.rgb),
    }  # fmt: skip
    save_scene(scene_file(experiment), trained.scene, trained.occupied, metadata)
    compare_views(experiment, experiment.view, _TRAINING_SHARE, report)
    checkpoint.unlink(missing_ok=True)


def field_config(experiment: Experiment) -> SceneFieldConfig:
    """A field in the box that the site is learned in."""
    wanted = experiment.config.scene
    grid = HashGridConfig(levels=wanted.levels, features=4, log2_entries=wanted.log2_entries, finest=wanted.finest)
    return experiment.site.field_config(grid, wanted.margin_m)
