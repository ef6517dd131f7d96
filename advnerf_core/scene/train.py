"""Training a scene field from posed images: batches of pixels, a learning occupancy grid, Adam, resumable checkpoints."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save as save_arrays

from advnerf_core.data.views import ImageSet
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import read_tensors, write_atomically
from advnerf_core.render.march import MarchConfig, Marcher, Samples
from advnerf_core.render.occupancy import Leaps, OccupancyGrid, leap_distances, refine_occupied
from advnerf_core.render.rays import intrinsics_row, pixel_rays, poses_in_box
from advnerf_core.scene.exposure import Exposures, RayGains
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.intervals import pixel_intervals
from advnerf_core.scene.torch_step import TorchStep
from advnerf_core.scene.train_config import TrainConfig, TrainedScene, TrainingReport
from advnerf_core.scene.train_step import CpuStep, Matte, StepResult

Array32 = NDArray[np.float32]
# Settings that older checkpoints do not have, with their neutral values.
_LATER = {"exposure": False, "decay": "exponential"}


def training_fingerprint(
    images: ImageSet, field: SceneFieldConfig, config: TrainConfig, march: MarchConfig
) -> str:
    """Hash of a training's images and settings, 16 hexadecimal digits: a checkpoint can only be resumed with the same.

    Args:
        march: The chosen intervals, which also depend on the cameras and on the rule.
    """
    training = {**asdict(config), "march": asdict(march)}
    for name, usual in _LATER.items():
        if training[name] == usual:
            del training[name]
    digest = hashlib.sha256(json.dumps([field.to_dict(), training], sort_keys=True).encode())
    digest.update(str(images.rgb.shape).encode() + images.T_world_from_camera.tobytes())
    digest.update(images.rgb[:, ::16, ::16].tobytes())
    if images.alpha is not None and not field.learned_background:
        digest.update(images.alpha[:, ::16, ::16].tobytes())
    if images.valid is not None:
        digest.update(np.flatnonzero(images.valid).tobytes())
    return digest.hexdigest()[:16]


def stepper_for(scene: SceneField, config: TrainConfig) -> CpuStep | TorchStep:
    """The training step of a configuration; the torch one runs on an accelerator, if there is one."""
    opacity = config.opacity if scene.config.learned_background else 0.0
    if config.backend != "numba":
        device = torch.device("cpu")
        if torch.cuda.is_available():
            # Imported here, as it loads what searches need.
            from advnerf_core.scene.agreement import training_device

            device = training_device()
        if config.backend == "torch" or device.type != "cpu":
            return TorchStep(scene.to(device), config.huber, opacity=opacity)
    return CpuStep(scene, config.huber, opacity=opacity)


class CheckpointError(AdvnerfError):
    """A checkpoint cannot be resumed."""


class Trainer:
    """State of a training; ``run`` continues until it is done.

    Args:
        images: Training images. Their alpha counts if the field has no learned background: each ray is then compared before a
            random colour, so that nothing but the true opacity fits.
        field_config: Sizes of the field, and its box.

    Attributes:
        march: Placement of samples, in training and for rendering.
        exposures: Gains of the photographs; None if they are not learned.
    """

    def __init__(
        self, images: ImageSet, field_config: SceneFieldConfig, config: TrainConfig | None = None
    ) -> None:
        self.images, self.config = images, config or TrainConfig()
        if images.alpha is None and not field_config.learned_background:
            raise AdvnerfError(
                "expected images with alpha for a field without a learned background, got opaque ones"
            )
        self.scene = SceneField(field_config, seed=self.config.seed)
        self.stepper = stepper_for(self.scene, self.config)
        self.exposures = Exposures(len(images.rgb)) if self.config.exposure else None
        self.occupancy = OccupancyGrid(
            field_config.box_high,
            self.config.occupancy_resolution,
            self.config.seed,
            field_config.contraction,
        )
        self.step, self.elapsed_s = 0, 0.0
        self.rays_per_step = min(self.config.max_rays, 2048)
        self.history: list[tuple[int, float, float]] = []
        unit_m = field_config.ray_unit_m
        self._poses = poses_in_box(
            images.T_world_from_camera, field_config.origin_m, field_config.extent_m, unit_m
        )
        self._intrinsics = np.stack([intrinsics_row(p) for p in images.pinholes])
        self.march = self.config.march or pixel_intervals(
            images.pinholes,
            images.T_world_from_camera,
            field_config,
            self.config.near_m,
            self.config.interval_px,
        )
        capacity = int(1.25 * self.config.samples_per_step)
        self._marcher = Marcher(
            capacity, self.march.in_unit(unit_m), field_config.box_high, field_config.contraction
        )
        # Pixels to learn from, if a mask or an undistortion leaves some out.
        self._usable = None if images.valid is None else np.flatnonzero(images.valid)
        if self._usable is not None and not len(self._usable):
            raise AdvnerfError(
                "expected pixels to learn from, the masks leave none: are they the right way round?"
            )
        self._fingerprint = training_fingerprint(images, field_config, self.config, self.march)
        # Not in the fingerprint, so that checkpoints of earlier versions, which lack it, can still be resumed.
        self._cameras = hashlib.sha256(self._intrinsics.tobytes()).hexdigest()
        self._leaps: Leaps | None = None
        self._recent: list[StepResult] = []

    @property
    def fraction(self) -> float:
        """Finished share of the training."""
        by_steps = self.step / self.config.steps
        by_time = 0.0 if self.config.max_seconds is None else self.elapsed_s / self.config.max_seconds
        return min(1.0, max(by_steps, by_time))

    def run(
        self,
        progress: Callable[[TrainingReport], None] | None = None,
        checkpoint: Path | None = None,
        report_every: int = 50,
    ) -> TrainedScene:
        """Train to the end.

        Args:
            progress: Called every ``report_every`` steps.
            checkpoint: File to save to regularly, and to resume from if it exists.
            report_every: Steps between reports.

        Raises:
            CheckpointError: The checkpoint exists but cannot be used.
        """
        if checkpoint is not None and checkpoint.exists():
            self.restore(checkpoint)
        saved_s = self.elapsed_s
        while self.fraction < 1.0:
            began = time.perf_counter()
            self._recent.append(self.train_step())
            self.elapsed_s += time.perf_counter() - began
            if self.step % report_every == 0 or self.fraction >= 1.0:
                self._report(progress)
            if checkpoint is not None and self.elapsed_s - saved_s > self.config.checkpoint_every_s:
                self.save(checkpoint)
                saved_s = self.elapsed_s
        if checkpoint is not None:
            self.save(checkpoint)
        occupied = refine_occupied(
            self.occupied(),
            self.occupancy.box_high,
            self.stepper.log_density,
            self.config.refine_depth,
            contracted=self.scene.config.contraction,
        )
        gains = None if self.exposures is None else np.exp(self.exposures.logs)
        return TrainedScene(self.scene.cpu(), occupied, self.march, self.history, gains)

    def train_step(self) -> StepResult:
        """One batch of random pixels; all randomness follows from the seed and the step number."""
        config = self.config
        self._refresh_occupancy()
        assert self._leaps is not None
        rng = np.random.Generator(np.random.Philox(key=[config.seed, 2 * self.step]))
        count = self.images.rgb[..., 0].size if self._usable is None else len(self._usable)
        drawn = rng.integers(0, count, self.rays_per_step)
        pixels = drawn if self._usable is None else self._usable[drawn]
        rays = np.empty((self.rays_per_step, 6), np.float32)
        colours = np.empty((self.rays_per_step, 3), np.uint8)
        pixel_rays(pixels, self.images.rgb, self._poses, self._intrinsics, rays, colours)
        samples, kept = self._marcher(
            rays, rng.random(len(rays), dtype=np.float32), self._leaps, self._step_scale()
        )
        matte, exposure = self._matte(pixels, kept, rng), self._exposure(pixels[kept])
        result = self._optimise(rays[kept], colours[kept], samples, matte, exposure)
        per_ray = max(len(samples.points) / max(len(kept), 1), 1.0)
        wanted = config.samples_per_step / per_ray
        # Follow slowly: the next batch may hold more samples per ray than this one.
        self.rays_per_step = int(np.clip(0.5 * self.rays_per_step + 0.5 * wanted, 256, config.max_rays))
        self.step += 1
        return result

    def occupied(self) -> NDArray[np.bool_]:
        """Currently occupied cells ``[X, Y, Z]``."""
        # A cell counts if its density would be visible in the shortest interval: 1 % opacity.
        smallest = self.march.smallest_step_m / self.scene.config.extent_m
        return self.occupancy.occupied(0.01 / smallest)

    def save(self, path: Path) -> None:
        """Write a checkpoint, atomically."""
        tensors = {**self.stepper.state(), **self._exposure_state(), "occupancy": self.occupancy.density}
        state = {
            "step": self.step,
            "elapsed_s": self.elapsed_s,
            "rays_per_step": self.rays_per_step,
            "history": self.history,
            "fingerprint": self._fingerprint,
            "cameras": self._cameras,
        }
        write_atomically(path, save_arrays(tensors, {"state": json.dumps(state)}))

    def restore(self, path: Path) -> None:
        """Resume from a checkpoint of the same training.

        Raises:
            CheckpointError: The file cannot be read, or belongs to other images or settings.
        """
        try:
            header, tensors = read_tensors(path, "numpy")
            state: dict[str, Any] = json.loads(header["state"])
        except (OSError, KeyError, ValueError) as error:
            raise CheckpointError(
                f"expected a training checkpoint at {path}, got: {error!r}; delete it to train from the start"
            ) from error
        same_cameras = state.get("cameras", self._cameras) == self._cameras
        if state["fingerprint"] != self._fingerprint or not same_cameras:
            raise CheckpointError(
                f"expected a checkpoint of these images and settings at {path}, got one of others; delete it to train anew"
            )
        self.stepper.load_state(tensors)
        self.occupancy.density[...] = tensors["occupancy"]
        for name, array in self._exposure_state().items():
            array[...] = tensors[name]
        self.step, self.elapsed_s = int(state["step"]), float(state["elapsed_s"])
        self.rays_per_step = int(state["rays_per_step"])
        self.history = [(int(a), float(b), float(c)) for a, b, c in state["history"]]
        # The grid in use dates from the last update, like the saved densities.
        self._leaps = leap_distances(self.occupied(), self.occupancy.cells) if self.step else None

    def _exposure(self, pixels: NDArray[np.int64]) -> RayGains | None:
        return (
            None if self.exposures is None else self.exposures.of(pixels // self.images.rgb[0, ..., 0].size)
        )

    def _exposure_state(self) -> dict[str, Array32]:
        return {} if self.exposures is None else self.exposures.state()

    def _matte(
        self, pixels: NDArray[np.int64], kept: NDArray[np.int64], rng: np.random.Generator
    ) -> Matte | None:
        """Opacities of pixels, and a random colour behind each; None if the background is learned."""
        if self.images.alpha is None or self.scene.config.learned_background:
            return None
        behind = rng.random((len(pixels), 3), dtype=np.float32)
        return Matte(self.images.alpha.reshape(-1)[pixels[kept]], behind[kept])

    def _optimise(
        self,
        rays: Array32,
        colours: NDArray[np.uint8],
        samples: Samples,
        matte: Matte | None,
        exposure: RayGains | None,
    ) -> StepResult:
        # Only once geometry is learned: earlier, pulling weights together freezes surfaces at wrong depths.
        self.stepper.distortion = self.config.distortion * min(1.0, max(0.0, 4.0 * self.fraction - 2.0))
        result = self.stepper.step(rays, colours, samples, matte, exposure)
        if not math.isfinite(result.loss):
            raise AdvnerfError(
                f"expected a finite loss, got {result.loss} at step {self.step}; lower the learning rate "
                f"({self.config.learning_rate}) or check the camera poses"
            )
        rate = self.config.rate(self.fraction)
        self.stepper.update(self.step, rate)
        if self.exposures is not None and exposure is not None:
            self.exposures.update(exposure, self.step, rate)
        return result

    def _refresh_occupancy(self) -> None:
        if self.step % self.config.occupancy_every and self._leaps is not None:
            return
        if self.step > 0:
            share = 1.0 if self.step <= self.config.warmup_steps else 0.25
            self.occupancy.update(self.stepper.log_density, self.step, share)
        self._leaps = leap_distances(self.occupied(), self.occupancy.cells)

    def _step_scale(self) -> float:
        """Factor on sample intervals: long while everything counts as occupied, 1 from the end of the warm-up."""
        return 1.0 + 5.0 * max(0.0, 1.0 - self.step / max(self.config.warmup_steps, 1))

    def _report(self, progress: Callable[[TrainingReport], None] | None) -> None:
        recent, self._recent = self._recent, []
        mse = float(np.mean([r.mse for r in recent])) if recent else float("nan")
        psnr_db = -10.0 * math.log10(max(mse, 1e-12))
        self.history.append((self.step, self.elapsed_s, psnr_db))
        if progress is None:
            return
        left = self.elapsed_s * (1.0 - self.fraction) / max(self.fraction, 1e-6)
        progress(TrainingReport(self.step, self.fraction, psnr_db, left))


def train_scene(
    images: ImageSet,
    field_config: SceneFieldConfig,
    config: TrainConfig | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[TrainingReport], None] | None = None,
) -> TrainedScene:
    """Train a scene field from the start, or from ``checkpoint`` if that exists.

    Args:
        images: Training images.
        field_config: Sizes of the field, and its box.
        checkpoint: File to save to and resume from.
        progress: Called every 50 steps.
    """
    with torch.no_grad():
        return Trainer(images, field_config, config).run(progress, checkpoint)
