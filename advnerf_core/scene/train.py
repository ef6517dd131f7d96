"""Training a scene field from posed images: batches of pixels, a learning occupancy grid, Adam, resumable checkpoints."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as save_arrays

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from advnerf_core.render.march import MarchConfig, Marcher, Samples
from advnerf_core.render.occupancy import Leaps, OccupancyGrid, leap_distances, refine_occupied
from advnerf_core.render.rays import intrinsics_row, pixel_rays, poses_in_box
from advnerf_core.scene.dataset import ImageSet
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.torch_step import TorchStep
from advnerf_core.scene.train_step import CpuStep, StepResult

Array32 = NDArray[np.float32]
BACKENDS = ("auto", "numba", "torch")


class CheckpointError(AdvnerfError):
    """A checkpoint cannot be resumed from; the message says why and what to do."""


@dataclass(frozen=True)
class TrainConfig:
    """How a scene is trained.

    Attributes:
        steps: Number of optimisation steps.
        max_seconds: Stop after this much training time, if sooner [s]; the learning rate then decays with time. Results with a
            time limit depend on the machine's speed; without one they are the same to the bit.
        samples_per_step: Samples that a step aims at; the number of rays follows from it.
        max_rays: Most rays in a step.
        learning_rate: Adam's rate at the start.
        final_rate: Factor on the rate at the end; between, it falls exponentially.
        huber: Where the loss turns from square to linear, in colour units 0..1.
        distortion: Weight of the distortion loss, which turns fog into surfaces.
        occupancy_resolution: Cells along the longest side of the box.
        occupancy_every: Steps between updates of the occupancy grid.
        warmup_steps: Steps during which sample intervals shrink to their final size and all cells are probed.
        march: How samples are placed.
        opacity: Weight of the rays' mean transmittance in the loss. A constant background is learned for what is left; without
            this pull it explains walls that all cameras see from one side, and is wrong from any other.
        render_step_scale: Sample intervals for rendering, in those of the training: a finished field is smooth along rays.
        refine_depth: Optical depth of crossing a fine cell from which rendering looks into it. Surfaces of a finished room are
            dense; where they may still be haze, as in large boxes or after short trainings, 0.005 keeps them whole.
        seed: Seed of everything random.
        checkpoint_every_s: Time between checkpoints [s].
        backend: ``numba`` (CPU kernels), ``torch`` (any device), or ``auto``: torch where it sees an accelerator, else numba.
    """

    steps: int = 1000
    max_seconds: float | None = None
    samples_per_step: int = 1 << 17
    max_rays: int = 1 << 14
    learning_rate: float = 1e-2
    final_rate: float = 0.03
    huber: float = 0.1
    distortion: float = 1e-2
    occupancy_resolution: int = 128
    occupancy_every: int = 16
    warmup_steps: int = 256
    march: MarchConfig = field(default_factory=MarchConfig)
    opacity: float = 1.5e-3
    render_step_scale: float = 2.0
    refine_depth: float = 0.05
    seed: int = 0
    checkpoint_every_s: float = 60.0
    backend: str = "auto"

    def __post_init__(self) -> None:
        if self.steps < 1 or self.samples_per_step < 1 or self.max_rays < 1:
            raise ValueError(f"expected at least one step, sample and ray, got {self}")
        if self.max_seconds is not None and not self.max_seconds > 0.0:
            raise ValueError(f"expected max_seconds > 0 or none, got {self.max_seconds}")
        if self.backend not in BACKENDS:
            raise ValueError(f"expected a backend of {', '.join(BACKENDS)}, got {self.backend!r}")


@dataclass(frozen=True)
class Progress:
    """What a running training reports.

    Attributes:
        step: Steps done.
        fraction: Share of the training that is done, by steps or time, whichever is ahead.
        loss: Huber loss, averaged over recent steps.
        psnr_db: PSNR of recent batches [dB].
        eta_s: Estimated time left [s].
        rays: Rays in the last step.
        samples_per_ray: Mean samples on a ray.
    """

    step: int
    fraction: float
    loss: float
    psnr_db: float
    eta_s: float
    rays: int
    samples_per_ray: float


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """A trained field with what a renderer needs.

    Attributes:
        scene: The field.
        occupied: Cells where something is ``[X, Y, Z]``, finer than in training.
        march: How to place samples for rendering.
        history: One row per report: step, elapsed [s], PSNR [dB].
    """

    scene: SceneField
    occupied: NDArray[np.bool_]
    march: MarchConfig
    history: list[tuple[int, float, float]]


class Trainer:
    """Holds the state of a training; ``run`` goes on until it is done.

    Args:
        images: Training images.
        field_config: Sizes of the field, and its box.
        config: How to train.
    """

    def __init__(self, images: ImageSet, field_config: SceneFieldConfig, config: TrainConfig | None = None) -> None:
        self.images, self.config = images, config or TrainConfig()
        self.scene = SceneField(field_config, seed=self.config.seed)
        self.stepper = _stepper(self.scene, self.config)
        self.occupancy = OccupancyGrid(field_config.box_high, self.config.occupancy_resolution, self.config.seed)
        self.step, self.elapsed_s = 0, 0.0
        self.rays_per_step = min(self.config.max_rays, 2048)
        self.history: list[tuple[int, float, float]] = []
        self._poses = poses_in_box(images.T_world_from_camera, field_config.box_low_m, field_config.extent_m)
        self._intrinsics = np.stack([intrinsics_row(p) for p in images.pinholes])
        capacity = int(1.25 * self.config.samples_per_step)
        self._marcher = Marcher(capacity, self.config.march, field_config.box_high)
        # Pixels to learn from, where a mask or an undistortion leaves some out.
        self._usable = None if images.valid is None else np.flatnonzero(images.valid)
        if self._usable is not None and not len(self._usable):
            raise AdvnerfError("expected pixels to learn from, the masks leave none: are they the right way round?")
        self._leaps: Leaps | None = None
        self._recent: list[StepResult] = []

    @property
    def fraction(self) -> float:
        """Share of the training that is done."""
        by_steps = self.step / self.config.steps
        by_time = 0.0 if self.config.max_seconds is None else self.elapsed_s / self.config.max_seconds
        return min(1.0, max(by_steps, by_time))

    def run(
        self,
        progress: Callable[[Progress], None] | None = None,
        checkpoint: Path | None = None,
        report_every: int = 50,
    ) -> TrainedScene:
        """Train to the end.

        Args:
            progress: Called every ``report_every`` steps.
            checkpoint: File to save to now and then, and to resume from if it exists.
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
            self.occupied(), self.occupancy.box_high, self.stepper.log_density, self.config.refine_depth
        )
        march = self.config.march.coarser(self.config.render_step_scale)
        return TrainedScene(self.scene.cpu(), occupied, march, self.history)

    def train_step(self) -> StepResult:
        """One batch of random pixels; all randomness follows from the seed and the step number."""
        config = self.config
        self._refresh_occupancy()
        assert self._leaps is not None
        rng = np.random.Generator(np.random.Philox(key=[config.seed, 2 * self.step]))
        if self._usable is None:
            pixels = rng.integers(0, self.images.rgb[..., 0].size, self.rays_per_step)
        else:
            pixels = self._usable[rng.integers(0, len(self._usable), self.rays_per_step)]
        rays = np.empty((self.rays_per_step, 6), np.float32)
        colours = np.empty((self.rays_per_step, 3), np.uint8)
        pixel_rays(pixels, self.images.rgb, self._poses, self._intrinsics, rays, colours)
        samples, kept = self._marcher(rays, rng.random(len(rays), dtype=np.float32), self._leaps, self._step_scale())
        result = self._optimise(rays[kept], colours[kept], samples)
        per_ray = max(len(samples.points) / max(len(kept), 1), 1.0)
        wanted = config.samples_per_step / per_ray
        # Follow slowly: the next batch may hold more samples per ray than this one.
        self.rays_per_step = int(np.clip(0.5 * self.rays_per_step + 0.5 * wanted, 256, config.max_rays))
        self.step += 1
        return result

    def occupied(self) -> NDArray[np.bool_]:
        """Cells where something is, now ``[X, Y, Z]``."""
        # A cell counts if its density would show in the shortest interval: 1 % opacity.
        smallest = self.config.march.smallest_step_m / self.scene.config.extent_m
        return self.occupancy.occupied(0.01 / smallest)

    def save(self, path: Path) -> None:
        """Write a checkpoint, atomically."""
        tensors = {**self.stepper.state(), "occupancy": self.occupancy.density}
        state = {
            "step": self.step,
            "elapsed_s": self.elapsed_s,
            "rays_per_step": self.rays_per_step,
            "history": self.history,
            "fingerprint": self._fingerprint(),
        }
        write_atomically(path, save_arrays(tensors, {"state": json.dumps(state)}))

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint of the same training.

        Raises:
            CheckpointError: It cannot be read, or belongs to other images or settings.
        """
        try:
            with safe_open(str(path), framework="numpy") as file:
                state: dict[str, Any] = json.loads((file.metadata() or {})["state"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            raise CheckpointError(
                f"expected a training checkpoint at {path}, got: {error!r}; delete it to train from the start"
            ) from error
        if state["fingerprint"] != self._fingerprint():
            raise CheckpointError(
                f"expected a checkpoint of these images and settings at {path}, got one of others; delete it to train anew"
            )
        self.stepper.load_state(tensors)
        self.occupancy.density[...] = tensors["occupancy"]
        self.step, self.elapsed_s = int(state["step"]), float(state["elapsed_s"])
        self.rays_per_step = int(state["rays_per_step"])
        self.history = [(int(a), float(b), float(c)) for a, b, c in state["history"]]
        # The grid in use is the one of the last update, which the saved densities are.
        self._leaps = leap_distances(self.occupied(), self.occupancy.cells) if self.step else None

    def _optimise(self, rays: Array32, colours: NDArray[np.uint8], samples: Samples) -> StepResult:
        # Only once geometry is found: earlier, pulling weights together freezes surfaces at wrong depths.
        self.stepper.distortion = self.config.distortion * min(1.0, max(0.0, 4.0 * self.fraction - 2.0))
        result = self.stepper.step(rays, colours, samples)
        if not math.isfinite(result.loss):
            raise AdvnerfError(
                f"expected a finite loss, got {result.loss} at step {self.step}; lower the learning rate "
                f"({self.config.learning_rate}) or check the camera poses"
            )
        self.stepper.update(self.step, self.config.learning_rate * self.config.final_rate**self.fraction)
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

    def _report(self, progress: Callable[[Progress], None] | None) -> None:
        recent, self._recent = self._recent, []
        mse = float(np.mean([r.mse for r in recent])) if recent else float("nan")
        psnr_db = -10.0 * math.log10(max(mse, 1e-12))
        self.history.append((self.step, self.elapsed_s, psnr_db))
        if progress is None:
            return
        left = self.elapsed_s * (1.0 - self.fraction) / max(self.fraction, 1e-6)
        rays, samples = sum(r.rays for r in recent), sum(r.samples for r in recent)
        loss = float(np.mean([r.loss for r in recent]))
        progress(Progress(self.step, self.fraction, loss, psnr_db, left, recent[-1].rays, samples / max(rays, 1)))

    def _fingerprint(self) -> str:
        digest = hashlib.sha256(json.dumps([asdict(self.scene.config), asdict(self.config)], sort_keys=True).encode())
        digest.update(str(self.images.rgb.shape).encode() + self.images.T_world_from_camera.tobytes())
        digest.update(self.images.rgb[:, ::16, ::16].tobytes())
        if self._usable is not None:
            digest.update(self._usable.tobytes())
        return digest.hexdigest()[:16]


def _stepper(scene: SceneField, config: TrainConfig) -> CpuStep | TorchStep:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if config.backend == "torch" or (config.backend == "auto" and device != "cpu"):
        return TorchStep(scene.to(device), config.huber, opacity=config.opacity)
    return CpuStep(scene, config.huber, opacity=config.opacity)


def train_scene(
    images: ImageSet,
    field_config: SceneFieldConfig,
    config: TrainConfig | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> TrainedScene:
    """Train a scene field from the start, or from ``checkpoint`` if that exists.

    Args:
        images: Training images.
        field_config: Sizes of the field, and its box.
        config: How to train.
        checkpoint: File to save to and resume from.
        progress: Called every 50 steps.
    """
    with torch.no_grad():
        return Trainer(images, field_config, config).run(progress, checkpoint)
