"""How near a car comes to what it cannot drive through, as a differentiable torch function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rectangle:
    """An oriented rectangle on the ground.

    Attributes:
        x_m: Centre [m].
        y_m: Centre [m].
        half_length_m: Half of the extent along its own x axis [m].
        half_width_m: Half of the extent along its own y axis [m].
        yaw_rad: Heading of its x axis [rad].
    """

    x_m: float
    y_m: float
    half_length_m: float
    half_width_m: float
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (self.half_length_m > 0.0 and self.half_width_m > 0.0):
            raise ValueError(f"expected a rectangle with half extents above 0 m, got {self}")


@dataclass(frozen=True)
class Solids:
    """Rectangles that a car can hit, and the car's body.

    The body is covered by equal discs along its length (Ziegler and Stiller 2010, "Fast collision checking for intelligent vehicle
    motion planning"), two for each width of the car. The discs reach beyond the body by at most 6 % of its width.

    Attributes:
        rectangles: What cannot be driven through; at least one.
        body: The car's body where its state is zero: the x axis points forward.
    """

    rectangles: tuple[Rectangle, ...]
    body: Rectangle

    def __post_init__(self) -> None:
        if not self.rectangles:
            raise ValueError("expected at least one solid rectangle, got none")

    def clearances_m(self, states: Tensor) -> Tensor:
        """Distance between the car and each rectangle [m], negative where they overlap.

        The distance of a disc's centre ``p`` to a rectangle is ``|max(q, 0)| + min(max(q), 0)`` with ``q = |R^T (p - c)| - h``.

        Args:
            states: ``[..., n]`` with x [m], y [m], yaw [rad] first.

        Returns:
            ``[..., K]`` for K rectangles, with gradients with respect to states.
        """
        centres, radius_m = self._discs(states)
        c_x, c_y, length, width, yaw = torch.tensor(
            [
                (each.x_m, each.y_m, each.half_length_m, each.half_width_m, each.yaw_rad)
                for each in self.rectangles
            ],
            dtype=states.dtype,
        ).T
        d_x, d_y = centres[..., 0, None] - c_x, centres[..., 1, None] - c_y
        along, across = d_x * yaw.cos() + d_y * yaw.sin(), d_y * yaw.cos() - d_x * yaw.sin()
        q = torch.stack([along.abs() - length, across.abs() - width], dim=-1)
        distance = torch.linalg.vector_norm(q.clamp(min=0.0), dim=-1) + q.amax(-1).clamp(max=0.0)
        return (distance - radius_m).amin(-2)

    def _discs(self, states: Tensor) -> tuple[Tensor, float]:
        """Centres ``[..., D, 2]`` [m] of the discs that cover the body, and their radius [m]."""
        offsets, radius_m = self._cover
        yaw = states[..., 2, None] + self.body.yaw_rad
        ahead = self.body.x_m + states.new_tensor(offsets)
        x = states[..., 0, None] + ahead * yaw.cos() - self.body.y_m * yaw.sin()
        y = states[..., 1, None] + ahead * yaw.sin() + self.body.y_m * yaw.cos()
        return torch.stack([x, y], dim=-1), radius_m

    @cached_property
    def _cover(self) -> tuple[Sequence[float], float]:
        """Where the discs are along the body [m], and their radius [m]."""
        half_length, half_width = self.body.half_length_m, self.body.half_width_m
        count = math.ceil(2.0 * half_length / half_width)
        spacing = 2.0 * half_length / count
        offsets = [(k + 0.5) * spacing - half_length for k in range(count)]
        return offsets, math.hypot(0.5 * spacing, half_width)
