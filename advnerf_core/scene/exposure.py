"""Exposure of each training photograph, learned with the scene: a gain per channel on the field's colours.

Phones choose exposure and white balance for each picture. A field without gains explains the differences by fog in front of
the cameras. Gains multiply stored values, not light: the power law of stored pictures turns a factor on light into a factor on values.

The mean of the logarithms over the photographs stays zero, so the scene keeps the average exposure, with which all later views are
rendered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.scene.field_kernels import adam

Array32 = NDArray[np.float32]

# Weight of the mean square of the logarithms in the loss: keeps a gain from explaining errors of a field at the start of training.
_PULL = 0.01


@dataclass(frozen=True, eq=False)
class RayGains:
    """Gains of the rays of a batch.

    Attributes:
        photographs: Index of each ray's photograph ``[R]``.
        gains: Factors on the colours ``[R, 3]``.
        grad_log: Gradient of the loss to the logarithm of the gains ``[R, 3]``, written by the training step.
    """

    photographs: NDArray[np.int64]
    gains: Array32
    grad_log: Array32


class Exposures:
    """Gains of all photographs, learned by Adam; their logarithms have mean zero in each channel.

    Args:
        count: Number of photographs P.

    Attributes:
        logs: Logarithms of the gains ``[P, 3]``.
    """

    def __init__(self, count: int) -> None:
        self.logs = np.zeros((count, 3), np.float32)
        self._grad, self._mean, self._square = (np.zeros_like(self.logs) for _ in range(3))

    def of(self, photographs: NDArray[np.int64]) -> RayGains:
        """Gains of rays of these photographs ``[R]``."""
        gains = np.exp(self.logs)[photographs]
        return RayGains(photographs, gains, np.zeros_like(gains))

    def update(self, rays: RayGains, step: int, rate: float) -> None:
        """Take one step of Adam.

        Photographs without a ray in the batch keep their gains, except for the shift to mean zero.

        Args:
            rays: The batch, with its gradient.
            rate: Learning rate of the field.
        """
        pull = np.float32(_PULL / (3.0 * max(len(rays.photographs), 1)))
        for channel in range(3):
            slope = rays.grad_log[:, channel] + pull * self.logs[rays.photographs, channel]
            self._grad[:, channel] = np.bincount(rays.photographs, slope, minlength=len(self.logs))
        scales = (np.float32(1 / (1 - decay ** (step + 1))) for decay in (0.9, 0.99))
        flat = (a.reshape(-1) for a in (self.logs, self._grad, self._mean, self._square))
        adam(*flat, np.float32(rate), *scales, True)
        self.logs -= self.logs.mean(axis=0)

    def state(self) -> dict[str, Array32]:
        """Arrays of a checkpoint by name, not copied."""
        return {"exposure.logs": self.logs, "exposure.mean": self._mean, "exposure.square": self._square}
