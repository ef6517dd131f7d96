"""Settings, progress reports and result of training a scene field."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.field import SceneField

BACKENDS = ("auto", "numba", "torch")
DECAYS = ("exponential", "cosine")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of the training.

    Attributes:
        steps: Number of optimisation steps.
        max_seconds: Stop after this much training time, if sooner [s]; the learning rate then decays with time. Results with a
            time limit depend on the machine's speed; without one they are the same to the bit.
        samples_per_step: Intended samples per step, which determine the number of rays.
        max_rays: Most rays in a step.
        learning_rate: Adam's rate at the start.
        final_rate: Factor on the rate at the end.
        decay: Decay of the rate: ``exponential``, or ``cosine``, which stays high for longer.
        huber: Error at which the loss changes from square to linear, in colour units 0..1.
        distortion: Weight of the distortion loss, which turns fog into surfaces.
        occupancy_resolution: Cells along the longest side of the box, or of a contracted field's cube.
        occupancy_every: Steps between updates of the occupancy grid.
        warmup_steps: Steps during which sample intervals shrink to their final length and all cells are probed.
        march: Placement of samples, in training and rendering; None: by `pixel_intervals`, of the training images.
        near_m: Smallest learned distance from a camera [m]; None: a share of the box, see `pixel_intervals`; not used if
            ``march`` is given.
        interval_px: Sample intervals in pixels of the training images [px], instead of the rule's; not used if ``march`` is given.
        opacity: Weight of the rays' mean transmittance in the loss. A constant background is learned for the rest; without
            this pull it explains walls that all cameras see from one side, and is wrong from any other. Not used for images with
            alpha, which tell what is transparent.
        refine_depth: Optical depth of a fine cell above which rendering samples it. Surfaces of a finished room are
            dense; if they may still be haze, as in large boxes or after short trainings, 0.005 keeps them whole.
        exposure: Whether a gain per channel is learned for each photograph, for cameras that choose exposure and white balance
            themselves. The scene gets the mean exposure.
        seed: Seed of all randomness.
        checkpoint_every_s: Time between checkpoints [s].
        backend: ``numba`` (CPU kernels), ``torch`` (any device), or ``auto``: torch if it finds an accelerator, else numba.
    """

    steps: int = 1000
    max_seconds: float | None = None
    samples_per_step: int = 1 << 17
    max_rays: int = 1 << 14
    learning_rate: float = 1e-2
    final_rate: float = 0.03
    decay: str = "exponential"
    huber: float = 0.1
    distortion: float = 1e-2
    occupancy_resolution: int = 128
    occupancy_every: int = 16
    warmup_steps: int = 256
    march: MarchConfig | None = None
    near_m: float | None = None
    interval_px: float | None = None
    opacity: float = 1.5e-3
    refine_depth: float = 0.05
    exposure: bool = False
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
        if self.decay not in DECAYS:
            raise ValueError(f"expected a decay of {', '.join(DECAYS)}, got {self.decay!r}")

    def rate(self, fraction: float) -> float:
        """Adam's rate at a finished share of the training, 0..1."""
        if self.decay == "exponential":
            return self.learning_rate * self.final_rate**fraction
        high = 0.5 * (1.0 + math.cos(math.pi * fraction))
        return self.learning_rate * (self.final_rate + (1.0 - self.final_rate) * high)


@dataclass(frozen=True)
class TrainingReport:
    """Progress report of a training.

    Attributes:
        step: Number of finished steps.
        fraction: Finished share of the training, by steps or time, whichever is ahead.
        psnr_db: PSNR of recent batches [dB].
        eta_s: Estimated remaining time [s].
    """

    step: int
    fraction: float
    psnr_db: float
    eta_s: float


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """A trained field with the inputs of a renderer.

    Attributes:
        occupied: Occupied cells ``[X, Y, Z]``, finer than in training.
        march: Placement of samples, in training and for rendering.
        history: One row per report: step, elapsed [s], PSNR [dB].
        gains: Factors on the colours for each photograph ``[P, 3]``, whose logarithms have mean zero; None if not learned.
    """

    scene: SceneField
    occupied: NDArray[np.bool_]
    march: MarchConfig
    history: list[tuple[int, float, float]]
    gains: NDArray[np.float32] | None = None
