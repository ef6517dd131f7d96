"""Regularises textures so that they hold beyond the frames they were optimised on: random image disturbances, and smoothness.

A disturbed attack minimises an expectation (Athalye et al. 2018, "Synthesizing Robust Adversarial Examples"): every evaluation draws
the exposure of each drive and the noise and camera jitter of each frame. A draw depends on seed, number of the evaluation
and tick only, so the backward pass gets exactly the frames of the forward pass, and a resumed attack gets the same as an
uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import squash, squash_derivative
from advnerf_core.geometry import Array
from advnerf_core.scene.surrogate import Rendered, split_theta

# Streams of draws: per drive, and per frame.
_DRIVE, _FRAME = 0, 1
# Colour differences much below this count as smooth; it keeps the slope of |difference| finite at zero.
_SOFT_DIFFERENCE = 1e-2


@runtime_checkable
class PosedSensor(Protocol):
    """A sensor whose camera can be moved, such as a ``Surrogate``."""

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""

    def render(self, T_world_from_camera: Array, theta: Tensor) -> Rendered:
        """Images at camera poses with their vjp."""


@dataclass(frozen=True)
class Disturbances:
    """Random disturbances of the images; all are standard deviations of normal distributions.

    Attributes:
        noise: Noise of each channel of each pixel, in 0..1, independent in each frame.
        gain: Logarithm of a drive's exposure.
        brightness: Additive brightness of a drive, in 0..1.
        jitter_m: Camera position along each of its axes, independent in each frame [m].
        jitter_rad: Camera rotation about each of its axes, independent in each frame [rad].
    """

    noise: float = 0.0
    gain: float = 0.0
    brightness: float = 0.0
    jitter_m: float = 0.0
    jitter_rad: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        spreads = (self.noise, self.gain, self.brightness, self.jitter_m, self.jitter_rad)
        if not all(0.0 <= spread < np.inf for spread in spreads):
            raise ValueError(f"expected finite spreads >= 0, got {self}")

    @property
    def moves_the_camera(self) -> bool:
        """Whether camera poses differ from the nominal ones."""
        return self.jitter_m > 0.0 or self.jitter_rad > 0.0

    def camera_poses(self, poses: Array, ticks: Sequence[int], draw: int) -> Array:
        """Camera poses ``[ticks * starts, 4, 4]``, ordered by tick, moved in their own frames."""
        starts = len(poses) // len(ticks)
        moves = np.tile(np.eye(4), (len(poses), 1, 1))
        for k, tick in enumerate(ticks):
            numbers = self._generator(_FRAME, draw, tick).standard_normal((starts, 6))
            rows = slice(k * starts, (k + 1) * starts)
            moves[rows, :3, :3] = Rotation.from_rotvec(self.jitter_rad * numbers[:, :3]).as_matrix()
            moves[rows, :3, 3] = self.jitter_m * numbers[:, 3:]
        return poses @ moves

    def disturb(self, rendered: Rendered, ticks: Sequence[int], draw: int) -> Rendered:
        """Apply exposure and noise; values outside 0..1 are clipped and have no gradient."""
        images = rendered.images
        starts = len(images) // len(ticks)
        drive = self._generator(_DRIVE, draw, 0).standard_normal((starts, 2))
        gain = _as_images(np.exp(self.gain * drive[:, 0]), images, len(ticks))
        exposed = images * gain + _as_images(self.brightness * drive[:, 1], images, len(ticks))
        if self.noise > 0.0:
            exposed += self.noise * torch.cat([self._noise(images, starts, draw, tick) for tick in ticks])
        inside = (exposed > 0.0) & (exposed < 1.0)
        vjp = rendered.vjp
        return Rendered(
            exposed.clamp(0.0, 1.0),
            lambda grad: vjp(grad * gain * inside),
            rendered.nbytes + inside.nbytes + gain.nbytes,
        )

    def _noise(self, images: Tensor, starts: int, draw: int, tick: int) -> Tensor:
        generator = torch.Generator().manual_seed(
            int(self._generator(_FRAME, draw, tick).integers(2**63 - 1))
        )
        return torch.randn((starts, *images.shape[1:]), generator=generator, dtype=torch.float32).to(images)

    def _generator(self, stream: int, draw: int, tick: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, stream, draw, tick])


def _as_images(values: NDArray[np.float64], images: Tensor, ticks: int) -> Tensor:
    return torch.from_numpy(np.tile(values, ticks)).to(images)[:, None, None, None]


class Smoothness:
    """Total variation of the objects' colours: the mean over neighbouring free cells of their difference.

    ``TV = mean over pairs of sum over channels of sqrt(d^2 + e^2) - e`` with ``d`` the difference of squashed colours and a small ``e``
    (Rudin, Osher and Fatemi 1992, softened at zero).

    Args:
        objects: The attacked objects, in the order of theta.
        weight: Loss [m] added by a TV of one.
    """

    def __init__(self, objects: Sequence[ColouredObject], weight: float) -> None:
        if not 0.0 <= weight < np.inf:
            raise ValueError(f"expected a finite weight >= 0, got {weight}")
        self.weight = weight
        self._objects = tuple(objects)
        self._pairs = [torch.from_numpy(field.neighbours()) for field in objects]
        self._count = max(1, sum(len(pairs) for pairs in self._pairs))

    def __call__(self, theta: Tensor) -> tuple[float, Tensor]:
        """The regulariser's part of the loss, and its gradient with respect to ``theta``, of the same shape."""
        total, slopes = 0.0, []
        for part, pairs in zip(split_theta(self._objects, theta.detach()), self._pairs, strict=True):
            colours = squash(part).reshape(-1, 3)
            d = colours[pairs[:, 0]] - colours[pairs[:, 1]]
            size = torch.sqrt(d * d + _SOFT_DIFFERENCE**2)
            total += float((size - _SOFT_DIFFERENCE).sum())
            slope = torch.zeros_like(colours)
            slope.index_add_(0, pairs[:, 0], d / size)
            slope.index_add_(0, pairs[:, 1], -d / size)
            slopes.append(slope * squash_derivative(part).reshape(-1, 3))
        scale = self.weight / self._count
        return scale * total, scale * torch.cat(slopes).reshape(theta.shape)
