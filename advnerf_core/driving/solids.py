"""Clearance between a car and obstacles, as a differentiable torch function."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advnerf_core.geometry import Rectangle


@dataclass(frozen=True)
class Solids:
    """Rectangles that a car can hit, and the car's body.

    Attributes:
        rectangles: Obstacles; at least one.
        body: The car's body where its state is zero: the x axis points forward.
    """

    rectangles: tuple[Rectangle, ...]
    body: Rectangle

    def __post_init__(self) -> None:
        if not self.rectangles:
            raise ValueError("expected at least one solid rectangle, got none")

    def clearances_m(self, states: Tensor) -> Tensor:
        """Signed distance between the car's body and each rectangle [m].

        Apart, it is the distance from the nearest corner of one to the other. Where they overlap, it is minus the depth of penetration: the
        shortest way that separates them, by the separating axis theorem.

        Args:
            states: ``[..., n]`` with x [m], y [m], yaw [rad] first.

        Returns:
            ``[..., K]`` for K rectangles, with gradients with respect to states.
        """
        x, y, yaw, *car = self._body_at(states)
        rows = [(r.x_m, r.y_m, r.yaw_rad, r.half_length_m, r.half_width_m) for r in self.rectangles]
        x_k, y_k, yaw_k, *box = torch.tensor(rows, dtype=states.dtype).T
        half_car, half_box = torch.stack(torch.broadcast_tensors(*car), -1), torch.stack(box, -1)
        turn = yaw_k - yaw
        from_car = _turned(torch.stack([x_k - x, y_k - y], dim=-1), -yaw)
        from_box = _turned(torch.stack([x - x_k, y - y_k], dim=-1), -yaw_k)
        gap = torch.cat(
            [
                from_car.abs() - half_car - _extent(half_box, turn),
                from_box.abs() - half_box - _extent(half_car, turn),
            ],
            dim=-1,
        ).amax(-1)
        nearest = torch.minimum(
            _nearest_corner(from_car, half_box, turn, half_car),
            _nearest_corner(from_box, half_car, -turn, half_box),
        )
        return torch.where(gap > 0.0, nearest, gap)

    def _body_at(self, states: Tensor) -> tuple[Tensor, ...]:
        """Centre x and y [m], yaw [rad], ``[..., 1]``, and half extents [m] of the body at states."""
        body, heading = self.body, states[..., 2, None]
        offset = states.new_tensor([body.x_m, body.y_m])
        centre = states[..., None, :2] + _turned(offset, heading)
        half = states.new_tensor([body.half_length_m, body.half_width_m])
        return centre[..., 0], centre[..., 1], heading + body.yaw_rad, half[0], half[1]


def _turned(points: Tensor, angle: Tensor) -> Tensor:
    """Points ``[..., 2]`` rotated by angles ``[...]``, left positive."""
    c, s, x, y = angle.cos(), angle.sin(), points[..., 0], points[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


def _extent(half: Tensor, turn: Tensor) -> Tensor:
    """Half extents ``[..., 2]`` along the axes of a frame of a rectangle that is turned in it."""
    c, s = turn.cos().abs(), turn.sin().abs()
    return torch.stack([half[..., 0] * c + half[..., 1] * s, half[..., 0] * s + half[..., 1] * c], dim=-1)


def _nearest_corner(centre: Tensor, half: Tensor, turn: Tensor, other_half: Tensor) -> Tensor:
    """Distance from a rectangle, in its own frame and of half extents ``other_half``, to the nearest corner of another one; 0 inside."""
    signs = half.new_tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    corners = centre[..., None, :] + _turned(signs * half[..., None, :], turn[..., None])
    outside = (corners.abs() - other_half[..., None, :]).clamp(min=0.0)
    return torch.linalg.vector_norm(outside, dim=-1).amin(-1)
