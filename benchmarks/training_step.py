"""What do kernels and skipping of empty space save? One training step of the lab's scene, and the same step done plainly, in one run.

Both learn from the same 1024 rays of the lab with the same field, the same sample spacing, the same loss and the same optimiser. The
plain one encodes by torch indexing and looks everywhere along each ray; ours asks the occupancy grid, which a short training filled
first, as in any training.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from torch import Tensor, nn

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGrid, encode_reference
from advnerf_core.parallel import thread_count
from advnerf_core.policies.view import PolicyView
from advnerf_core.render.march import Marcher
from advnerf_core.render.occupancy import Leaps, leap_distances
from advnerf_core.render.rays import intrinsics_row, pixel_rays, poses_in_box
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.torch_step import TorchStep
from advnerf_core.scene.train import TrainConfig, Trainer
from advnerf_core.scene.train_step import CpuStep
from benchmarks.results import record_row
from benchmarks.timing import seconds_in_turns
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import walk_around_poses

COMMAND = "python -m benchmarks.training_step"
TARGET = 10.0
MARGIN_M = 0.05


class PlainGrid(nn.Module):
    """A hash grid that always encodes by torch indexing."""

    def __init__(self, grid: HashGrid) -> None:
        super().__init__()
        self.config, self.levels, self.table = grid.config, grid.levels, grid.table

    def forward(self, points: Tensor) -> Tensor:
        """``[N, 3]`` to ``[N, L * F]``."""
        return encode_reference(points, self.table, self.levels)


class Batch:
    """The same rays, sampled with an occupancy grid or everywhere."""

    def __init__(self, images: ImageSet, trainer: Trainer, rays: int) -> None:
        self.trainer, field = trainer, trainer.scene.config
        rng = np.random.default_rng(1)
        self.rays, self.colours = np.empty((rays, 6), np.float32), np.empty((rays, 3), np.uint8)
        poses = poses_in_box(images.T_world_from_camera, field.box_low_m, field.extent_m)
        intrinsics = np.stack([intrinsics_row(pinhole) for pinhole in images.pinholes])
        pixels = rng.integers(0, images.rgb[..., 0].size, rays)
        pixel_rays(pixels, images.rgb, poses, intrinsics, self.rays, self.colours)
        self.jitter = rng.random(rays, dtype=np.float32)
        march = trainer.march
        self.marcher = Marcher(rays * march.max_samples * 2, march, field.box_high)
        self.skipping = leap_distances(trainer.occupied(), trainer.occupancy.cells)
        everywhere = np.ones(trainer.occupancy.shape, np.bool_)
        self.everywhere = leap_distances(everywhere, trainer.occupancy.cells)

    def ours(self, stepper: CpuStep) -> int:
        """One step with kernels and the grid; returns the number of samples that were looked at."""
        samples, kept = self.marcher(self.rays, self.jitter, self.skipping)
        stepper.step(self.rays[kept], self.colours[kept], samples)
        return self._update(stepper, len(samples.points), len(kept))

    def plainly(self, stepper: TorchStep, leaps: Leaps | None = None, hidden: bool = True) -> int:
        """One step in plain torch, on all samples or without the hidden ones as in ours; returns how many were looked at."""
        samples, kept = self.marcher(self.rays, self.jitter, leaps or self.everywhere)
        (stepper.gradients if hidden else stepper.step)(self.rays[kept], self.colours[kept], samples)
        return self._update(stepper, len(samples.points), len(kept))

    def _update(self, stepper: CpuStep | TorchStep, samples: int, kept: int) -> int:
        if kept != len(self.rays):
            raise RuntimeError(f"expected all {len(self.rays)} rays to fit the buffers, {kept} did")
        # A rate of zero costs the same and leaves every repetition the same work.
        stepper.update(self.trainer.step, 0.0)
        return samples


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument(
        "--steps", type=int, default=300, help="steps of training that fill the occupancy grid"
    )
    parser.add_argument("--photographs", type=int, default=40)
    parser.add_argument(
        "--repeats", type=int, default=5, help="timed runs of each way, in turns; medians count"
    )
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    arguments = parser.parse_args()

    images, field = photograph_lab(arguments.photographs)
    batch, ours, plain = prepare(images, field, arguments.steps, arguments.rays)
    few, many = batch.ours(ours), batch.plainly(plain)
    seconds = seconds_in_turns(
        {
            "ours": lambda: batch.ours(ours),
            "plain with the grid": lambda: batch.plainly(plain, batch.skipping),
            "plain": lambda: batch.plainly(plain),
            "plain without hidden samples": lambda: batch.plainly(plain, hidden=False),
        },
        arguments.repeats,
    )
    # The quicker of the two plain ways is what ours is held against.
    plain_s = min(seconds["plain"], seconds["plain without hidden samples"])
    ratio = plain_s / seconds["ours"]
    note = (
        f"{1e3 * seconds['ours']:.0f} ms and {few / arguments.rays:.0f} samples a ray against {1e3 * plain_s:.0f} ms and "
        f"{many / arguments.rays:.0f}; plain torch with the grid {1e3 * seconds['plain with the grid']:.0f} ms; medians of "
        f"{arguments.repeats} in turns; {thread_count()} threads, after {arguments.steps} steps"
    )
    print(f"{ratio:.1f} x: {note}")
    if not arguments.trial:
        line = "training step, 1024 rays, lab, against plain torch without occupancy grid"
        record_row(line, ratio, "x", ">= 10 x", ratio >= TARGET, COMMAND, note)


def photograph_lab(count: int) -> tuple[ImageSet, SceneFieldConfig]:
    """Phone photographs of the lab, and the box of its room."""
    config = LabConfig()
    poses = walk_around_poses(config, count, np.random.default_rng(0))
    with Lab(config) as lab:
        rgb = np.stack([lab.photograph(pose) for pose in poses])
    half = 0.5 * config.room.side_m + MARGIN_M
    box = SceneFieldConfig((-half, -half, -MARGIN_M), (half, half, config.room.height_m + MARGIN_M))
    return ImageSet(rgb, (config.phone.pinhole,) * count, np.stack(poses)), box


def prepare(
    images: ImageSet, field: SceneFieldConfig, steps: int, rays: int
) -> tuple[Batch, CpuStep, TorchStep]:
    """A batch, and the two ways to take a step on it from the same state of training."""
    view = PolicyView(LabConfig().camera.pinhole).pinhole
    config = TrainConfig(
        steps=steps, backend="numba", march=pixel_intervals([view], images.T_world_from_camera, field)
    )  # as experiments train
    trainer = Trainer(images, field, config)
    for _ in range(steps):
        trainer.train_step()
    ours = trainer.stepper
    if not isinstance(ours, CpuStep):
        raise RuntimeError(f"expected the kernels, got {type(ours).__name__}")
    scene = SceneField(field)
    scene.load_state_dict(trainer.scene.state_dict())
    scene.grid = PlainGrid(scene.grid)  # type: ignore[assignment]
    plain = TorchStep(scene, trainer.config.huber, ours.distortion, ours.opacity)
    return Batch(images, trainer, rays), ours, plain


if __name__ == "__main__":
    torch.set_num_threads(thread_count())
    main()
