"""Policies that see several images at once: the latest ones, at a fixed spacing in ticks."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from advnerf_core.policies.arrays import array_module
from advnerf_core.strict import StrictModel


class FrameStack(StrictModel):
    """Past images in an input, and their order.

    Attributes:
        count: Number of images in the input, the present one included.
        spacing: Ticks between two of them; a tick is one image of the drive.
        first: Replacement for images before the first tick: the first image (``repeat``), or ``black`` ones.
        axis: ``channels`` for one input of ``count`` times the channels, or ``time`` for a separate axis before the image's.
        order: ``oldest_first``, or ``newest_first``.
    """

    count: int = Field(ge=2, le=64)
    spacing: int = Field(default=1, ge=1, le=64)
    first: Literal["repeat", "black"] = "repeat"
    axis: Literal["channels", "time"] = "channels"
    order: Literal["oldest_first", "newest_first"] = "oldest_first"

    @property
    def past(self) -> int:
        """Number of stored past images."""
        return (self.count - 1) * self.spacing

    def initial(self, batch: int, size: tuple[int, int]) -> NDArray[np.float32]:
        """Past images ``[B, past, 3, H, W]`` before the first tick. NaN marks images that the first one will replace."""
        value = np.nan if self.first == "repeat" else 0.0
        return np.full((batch, self.past, 3, *size), value, dtype=np.float32)

    def push(self, images: Any, past: Any) -> tuple[Any, Any]:
        """Add the present images (numpy or torch; differentiable in both arguments).

        Args:
            images: ``[B, 3, H, W]``.
            past: ``[B, past, 3, H, W]``, oldest first.

        Returns:
            The seen images ``[B, count, 3, H, W]`` in the stack's order, and the past images of the next tick.
        """
        module, present = array_module(images), images[:, None]
        if self.first == "repeat":
            past = module.where(module.isnan(past), present, past)
        known = module.concatenate([past, present], 1)
        chosen = range(0, self.past + 1, self.spacing)
        return known[:, list(chosen if self.order == "oldest_first" else reversed(chosen))], known[:, 1:]
