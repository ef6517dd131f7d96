"""The sensor of a pose attack: a surrogate whose objects are placed by theta, with exact derivatives and bounded memory.

``theta`` is one vector: coordinates of the placements in the unit box of a `PoseSpace`, four for each object, then the objects' colours if
they are free too. The objects have soft edges (``fields/soft_edges``) so that the picture changes smoothly as they move; searches take
gradients of these pictures, and drive past the true edges (`sharp`), as a deployment does. A render keeps only the covered pixels for its vector-Jacobian product.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.spaces.placement import PoseSpace, placed
from advnerf_core.fields.soft_edges import with_soft_edges
from advnerf_core.geometry import Array
from advnerf_core.render.composite import visible_shares
from advnerf_core.render.soft_pose import SoftLayer, soft_layer
from advnerf_core.scene.device_surrogate import background_on
from advnerf_core.scene.surrogate import Rendered, Surrogate, split_theta


@dataclass(frozen=True, eq=False)
class _Parts:
    """A theta taken apart: leaf tensors of the colours, and the colour vectors they give."""

    placements: Tensor
    leaves: tuple[Tensor, ...]
    colours: tuple[Tensor, ...]
    rows: tuple[Array, ...]


class PlacedSensor:
    """A surrogate that fits the attack's ``Sensor`` with placements, and colours if wanted, as its theta.

    Args:
        space: Allowed placements of the same objects.
        free_colours: Whether the colours belong to theta.
        colours: The colours if they are not free, of the surrogate's ``theta_shape``; plain ones if not given.
        edge_width: Width of the soft edges in object units, see ``with_soft_edges``.

    Raises:
        ValueError: The space belongs to other objects, or the colours have another shape.
    """

    def __init__(
        self,
        surrogate: Surrogate,
        space: PoseSpace,
        free_colours: bool = True,
        colours: Tensor | None = None,
        edge_width: float | None = None,
    ) -> None:
        same = [own is other for own, other in zip(surrogate.objects, space.objects, strict=False)]
        if len(space.objects) != len(surrogate.objects) or not all(same):
            raise ValueError(
                f"expected a space of the surrogate's own {len(surrogate.objects)} object(s), got one of {len(space.objects)}, "
                f"{sum(same)} of which are the surrogate's"
            )
        self.surrogate, self.space, self.free_colours = surrogate, space, free_colours
        self.fixed_colours = (
            surrogate.plain_theta(torch.float64) if colours is None else colours.detach().double()
        )
        if self.fixed_colours.shape != surrogate.theta_shape:
            raise ValueError(
                f"expected colours {surrogate.theta_shape}, got {tuple(self.fixed_colours.shape)}"
            )
        self._soft = tuple(with_soft_edges(each, edge_width) for each in space.objects)
        self._last: tuple[Tensor, int, _Parts] | None = None
        self._device: torch.device | None = None

    def on(self, device: torch.device) -> PlacedSensor:
        """The same, with background and objects computed on a device, in plain torch; images and gradients are on the CPU."""
        other = copy.copy(self)
        other._device = device
        other.surrogate = self.surrogate.with_background(background_on(device, self.surrogate.background))
        return other

    @property
    def pose_count(self) -> int:
        """Length of theta's part with the placements."""
        return 4 * len(self._soft)

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape of theta: one vector."""
        return (self.pose_count + (self.fixed_colours.numel() if self.free_colours else 0),)

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """An allowed pose drawn at random, with plain colours and their starting noise, float64."""
        unit = self.space.draw(generator)
        return self.join(unit, self.surrogate.initial_theta(generator, torch.float64))

    def join(self, unit: Tensor, colours: Tensor) -> Tensor:
        """Theta of coordinates ``[K, 4]`` and colours, which are left out if they are not free."""
        return torch.cat([unit.double().flatten(), colours.double().flatten()])[: self.theta_shape[0]]

    def unit(self, theta: Tensor) -> Tensor:
        """Coordinates ``[K, 4]`` in the unit box."""
        return theta[: self.pose_count].reshape(-1, 4)

    def placements(self, theta: Tensor) -> Tensor:
        """Placements ``[K, 4]``: x [m], y [m], yaw [rad], scale."""
        return self.space.placements(self.unit(theta))

    def colours(self, theta: Tensor) -> Tensor:
        """Colours of the surrogate's ``theta_shape``, free or not."""
        if not self.free_colours:
            return self.fixed_colours
        return theta[self.pose_count :].reshape(self.surrogate.theta_shape)

    def sharp(self, theta: Tensor) -> tuple[Surrogate, Tensor]:
        """The surrogate with the objects at their placements, with true edges, and its theta (the colours)."""
        objects = placed(self.space.objects, self.placements(theta.detach()))
        return self.surrogate.with_objects(objects), self.colours(theta.detach()).to(self.surrogate.dtype)

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""
        return self.surrogate.camera_poses(states)

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        """Images at detached states ``[B, n]`` with their vjp."""
        return self.render(self.camera_poses(states), theta)

    @torch.no_grad()
    def render(self, T_world_from_camera: Array, theta: Tensor) -> Rendered:
        """Images at camera poses ``[B, 4, 4]`` with their vjp with respect to theta."""
        parts = self._parts(theta)
        rgb, depth_m = self.surrogate.scene_frames(T_world_from_camera)
        lens, supersample = self.surrogate.camera, self.surrogate.supersample
        layers = [
            soft_layer(field, place, rows, T_world_from_camera, lens, supersample, device=self._device)
            for field, place, rows in zip(self._soft, parts.placements, parts.rows, strict=True)
        ]
        stack = _Stack.of(layers, rgb, depth_m, self.surrogate.depth_tolerance_m)
        flat = rgb.reshape(-1, 3).clone()
        flat[stack.pixels] = stack.compose().to(flat.dtype)
        images = flat.reshape(rgb.shape).permute(0, 3, 1, 2).contiguous()
        held = images.nbytes + stack.nbytes + sum(layer.nbytes for layer in layers)
        return Rendered(images, lambda grad: self._vjp(parts, layers, stack, grad).to(theta.dtype), held)

    def _vjp(self, parts: _Parts, layers: Sequence[SoftLayer], stack: _Stack, grad_images: Tensor) -> Tensor:
        flat = grad_images.detach().double().permute(0, 2, 3, 1).reshape(-1, 3)
        slopes = stack.slopes(flat[stack.pixels])
        by_place, by_colour = [], []
        for k, layer in enumerate(layers):
            own = slopes[k][stack.rows[k]].numpy()
            place, rows = layer.pull(own, with_colours=self.free_colours)
            by_place.append(torch.from_numpy(place))
            if self.free_colours:
                (slope,) = torch.autograd.grad(
                    parts.colours[k], parts.leaves[k], torch.from_numpy(rows), retain_graph=True
                )
                by_colour.append(slope.flatten())
        return torch.cat([(torch.stack(by_place) * self.space.half).flatten(), *by_colour])

    def _parts(self, theta: Tensor) -> _Parts:
        """The parts of theta; cached, as a drive and its gradient ask for the same ones repeatedly."""
        if self._last is not None and self._last[0] is theta and self._last[1] == theta._version:
            return self._last[2]
        if tuple(theta.shape) != self.theta_shape:
            raise ValueError(f"expected theta of shape {self.theta_shape}, got {tuple(theta.shape)}")
        given = split_theta(self._soft, self.colours(theta.detach()).double())
        leaves = tuple(part.clone().requires_grad_(self.free_colours) for part in given)
        with torch.enable_grad():
            colours = tuple(field.colours(leaf) for field, leaf in zip(self._soft, leaves, strict=True))
        rows = tuple(np.ascontiguousarray(each.detach().numpy()) for each in colours)
        parts = _Parts(self.placements(theta.detach()), leaves, colours, rows)
        self._last = (theta, theta._version, parts)
        return parts


@dataclass(frozen=True, eq=False)
class _Stack:
    """All layers at the pixels that objects cover; the scene is the last layer.

    Attributes:
        pixels: Flat indices ``[U]`` into ``[B, H, W]``.
        rows: For each object, the indices of its own pixels among these.
        colours: ``[L, U, 3]``, premultiplied.
        alphas: ``[L, U]``.
        depths_m: ``[L, U]``.
    """

    pixels: Tensor
    rows: tuple[Tensor, ...]
    colours: Tensor
    alphas: Tensor
    depths_m: Tensor

    @classmethod
    def of(cls, layers: Sequence[SoftLayer], rgb: Tensor, depth_m: Tensor, tolerance_m: float) -> _Stack:
        union = np.unique(np.concatenate([layer.pixels for layer in layers]))
        pixels = torch.from_numpy(union)
        count = len(layers)
        colours = torch.zeros(count + 1, len(union), 3, dtype=torch.float64)
        alphas = torch.zeros(count + 1, len(union), dtype=torch.float64)
        depths = torch.full_like(alphas, torch.inf)
        rows = tuple(torch.from_numpy(np.searchsorted(union, layer.pixels)) for layer in layers)
        for k, (layer, row) in enumerate(zip(layers, rows, strict=True)):
            colours[k, row], alphas[k, row] = torch.from_numpy(layer.colour), torch.from_numpy(layer.alpha)
            depths[k, row] = torch.from_numpy(layer.depth_m) - tolerance_m
        colours[count], alphas[count] = rgb.reshape(-1, 3)[pixels].double(), 1.0
        depths[count] = torch.nan_to_num(depth_m.reshape(-1)[pixels].double(), nan=torch.inf)
        return cls(pixels, rows, colours, alphas, depths)

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        parts = (self.pixels, *self.rows, self.colours, self.alphas, self.depths_m)
        return sum(part.nbytes for part in parts)

    def compose(self) -> Tensor:
        """Colours ``[U, 3]``."""
        return (visible_shares(self.alphas, self.depths_m)[..., None] * self.colours).sum(0)

    def slopes(self, grad: Tensor) -> Tensor:
        """Derivatives ``[L, U, 4]`` with respect to premultiplied colour and alpha, from the composed colours' ``[U, 3]``."""
        colours, alphas = self.colours.clone().requires_grad_(), self.alphas.clone().requires_grad_()
        with torch.enable_grad():
            composed = (visible_shares(alphas, self.depths_m)[..., None] * colours).sum(0)
            by_colour, by_alpha = torch.autograd.grad(composed, (colours, alphas), grad)
        return torch.cat([by_colour, by_alpha[..., None]], dim=-1)
