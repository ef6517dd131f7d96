"""Renders of voxel-grid objects that are differentiable with respect to their placements: position, yaw and scale.

Where an object's density is soft, a picture changes smoothly as the object moves. Here rays are sampled at depths that do not depend
on the placement, so that the sum which makes the picture is a smooth function of it, and its derivative is exact and in closed
form (``pose_kernels``). The relevant samples (those in cells that are not empty, until nearly no light remains) are found
first and held fixed. Not differentiated: the order of layers in depth, and edges of a solid without density, which have no
derivative (``fields/soft_edges`` gives it a density).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, Pinhole, invert_transform, rotation_z, yaw_of
from advnerf_core.parallel import run_slots, slot_bounds
from advnerf_core.render.cast_object import KernelGrids, prepared, windows
from advnerf_core.render.cast_torch import TorchGrid, pixel_aims, pixel_parts, pixel_sums, voxel_edges
from advnerf_core.render.pose_kernels import SUMS, pull_pixels, shade_pixels

LEAST_TRANSMITTANCE = 1e-4
# Fixed parts of the work, so that sums have the same bits on any number of threads; each has its own sum over the colours.
_SLOTS = 4


def placement_of(field: VoxelGridObject) -> Tensor:
    """Placement of an object: ``(x_m, y_m, yaw_rad, scale)``, float64."""
    T = field.T_world_from_object
    return torch.tensor([T[0, 3], T[1, 3], yaw_of(T), field.scale], dtype=torch.float64)


def pose_of(field: VoxelGridObject, placement: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation ``[3, 3]`` and position ``[3]`` of an object placed at ``(x_m, y_m, yaw_rad, scale)``; it keeps height and tilt."""
    tilt = torch.tensor(
        rotation_z(-yaw_of(field.T_world_from_object)) @ field.T_world_from_object[:3, :3]
    ).to(placement)
    x, y, yaw = placement[0], placement[1], placement[2]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    turn = torch.stack([yaw.cos(), -yaw.sin(), zero, yaw.sin(), yaw.cos(), zero, zero, zero, one]).reshape(
        3, 3
    )
    return turn @ tilt, torch.stack([x, y, zero + float(field.T_world_from_object[2, 3])])


def placed_at(field: VoxelGridObject, placement: Tensor) -> VoxelGridObject:
    """The object at ``(x_m, y_m, yaw_rad, scale)``, without history."""
    R, t = pose_of(field, placement.detach().double())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.numpy(), t.numpy()
    return field.moved(T, float(placement.detach()[3]))


@dataclass(frozen=True, eq=False)
class SoftLayer:
    """Image layer of one object in a batch of images, with its derivative; made by `soft_layer`.

    Attributes:
        pixels: Flat indices into ``[B, H, W]`` of the pixels that the object covers at least in part, ``[P]`` int64, ascending.
        colour: Premultiplied, ``[P, 3]``.
        alpha: ``[P]`` in 0..1.
        depth_m: Planar depth, averaged with the rendering weights ``[P]`` [m]; without derivative.
    """

    pixels: NDArray[np.int64]
    colour: Array
    alpha: Array
    depth_m: Array
    _walk: _Walk | _TorchWalk

    @property
    def nbytes(self) -> int:
        """Memory held by the arrays [bytes], without the object's grids and colours."""
        return int(sum(part.nbytes for part in (self.pixels, self.colour, self.alpha, self.depth_m)))

    def pull(self, slopes: Array, with_colours: bool = True) -> tuple[Array, Array]:
        """The vector-Jacobian product.

        Args:
            slopes: Derivatives of a scalar with respect to red, green, blue and alpha of each pixel, ``[P, 4]``.
            with_colours: Whether the second result is wanted.

        Returns:
            Its derivatives with respect to ``(x_m, y_m, yaw_rad, scale)`` ``[4]``, and to the colour vector ``[rows, 3]`` (of no rows if
            it is not wanted).
        """
        return self._walk.pull(self.pixels, np.ascontiguousarray(slopes, np.float64), with_colours)


def soft_layer(
    field: VoxelGridObject,
    placement: ArrayLike,
    colours: ArrayLike,
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole,
    supersample: int = 2,
    least_transmittance: float = LEAST_TRANSMITTANCE,
    device: torch.device | None = None,
) -> SoftLayer:
    """The layer of one object at a placement, with the pixels that it covers.

    Args:
        field: The object; must have a density.
        placement: ``(x_m, y_m, yaw_rad, scale)``, finite, with a positive scale.
        colours: Colour vector of the object ``[rows, 3]`` (``VoxelGridObject.colours``).
        T_world_from_camera: ``[B, 4, 4]``.
        supersample: Rays along each side of a pixel.
        least_transmittance: A ray is followed until less light than this remains.
        device: Compute there, in plain torch; None uses the CPU kernels.

    Raises:
        ValueError: The object has no density, or the placement is invalid.
    """
    if field.density is None:
        raise ValueError(
            "expected an object with a density, got an opaque solid: its edges have no derivative"
        )
    place = torch.as_tensor(placement, dtype=torch.float64).detach()
    if place.shape != (4,) or not bool(torch.isfinite(place).all()) or float(place[3]) <= 0:
        raise ValueError(
            f"expected a finite placement (x, y, yaw, scale) with scale > 0, got {place.tolist()}"
        )
    poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    placed = placed_at(field, place)
    given = (placed, field, np.ascontiguousarray(colours, np.float64), poses, pinhole, supersample)
    walk: _Walk | _TorchWalk
    if device is None:
        walk = _Walk.of(*given, least_transmittance)
    else:
        walk = _TorchWalk(*given, least_transmittance, device)
    pixels = _window_pixels(placed, poses, pinhole)
    shown = walk.shade(pixels)
    kept = shown[:, 3] > 0.0
    alpha = shown[kept, 3]
    return SoftLayer(pixels[kept], shown[kept, :3], np.minimum(alpha, 1.0), shown[kept, 4] / alpha, walk)


@dataclass(frozen=True, eq=False)
class _Walk:
    """Intersections of one object with the rays of a batch of images."""

    grids: KernelGrids
    field: VoxelGridObject
    colours: Array
    R: Array
    o: Array
    edges: Array
    lens: Pinhole
    supersample: int
    step_m: float
    least: float

    @classmethod
    def of(
        cls,
        placed: VoxelGridObject,
        nominal: VoxelGridObject,
        colours: Array,
        poses: Array,
        lens: Pinhole,
        supersample: int,
        least: float,
    ) -> _Walk:
        grids = prepared(placed, np.float64)
        edges = (np.asarray(placed.box_max, np.float64) - placed.box_min) / grids.slots.shape
        T = invert_transform(placed.T_world_from_object) @ poses
        R = np.ascontiguousarray(T[:, :3, :3] / placed.scale / edges[:, None])
        o = np.ascontiguousarray((T[:, :3, 3] / placed.scale - placed.box_min) / edges - 0.5)
        step_m = nominal.step_units * nominal.scale
        return cls(grids, placed, colours, R, o, edges, lens, supersample, step_m, least)

    def shade(self, pixels: NDArray[np.int64]) -> Array:
        """Red, green, blue, alpha and alpha-weighted depth of pixels, ``[P, 5]``."""
        out = np.zeros((len(pixels), 5))
        bounds = slot_bounds(len(pixels), _SLOTS)
        run_slots(lambda k: shade_pixels(*bounds[k], *self._common(pixels), out), _SLOTS)
        return out

    def pull(self, pixels: NDArray[np.int64], slopes: Array, with_colours: bool) -> tuple[Array, Array]:
        """See `SoftLayer.pull`."""
        bounds = slot_bounds(len(pixels), _SLOTS)
        rows = np.zeros((_SLOTS, len(self.colours) if with_colours else 0, 3))
        sums, low = np.zeros((_SLOTS, SUMS)), np.asarray(self.field.box_min, np.float64)
        run_slots(
            lambda k: pull_pixels(
                *bounds[k], *self._common(pixels), slopes, low, self.edges, rows[k], sums[k]
            ),
            _SLOTS,
        )
        return self._by_placement(sums.sum(axis=0)), rows.sum(axis=0)

    def _by_placement(self, sums: Array) -> Array:
        # A point of the world is at p = R^T (q - position) / scale; d(R^T q)/dyaw turns it about the world's z axis.
        R, scale = self.field.T_world_from_object[:3, :3], self.field.scale
        by_position = -(R @ sums[:3]) / scale
        by_yaw = -(R[2] @ sums[3:6])
        return np.array([by_position[0], by_position[1], by_yaw, -(sums[6] + sums[7]) / scale])

    def _common(self, pixels: NDArray[np.int64]) -> tuple[Any, ...]:
        field, lens, grids = self.field, self.lens, self.grids
        extent_m = float(np.linalg.norm(np.asarray(field.box_max, np.float64) - field.box_min)) * field.scale
        room = int(extent_m / self.step_m) + 4
        return (
            pixels,
            self.R,
            self.o,
            np.array([lens.fx, lens.fy, lens.cx, lens.cy]),
            np.array([lens.height, lens.width]),
            self.supersample,
            grids.slots,
            grids.density,
            grids.clear,
            field.one_sided,
            self.step_m,
            float(field.scale),
            self.least,
            self.colours,
            np.empty(room),
            np.empty(room),
        )


class _TorchWalk:
    """Intersections of one object with the rays of a batch of images; a drop-in for the walk of `soft_layer`.

    Args:
        placed: The object at its placement; it has a density.
        nominal: The object at its nominal placement.
        colours: Colour vector ``[rows, 3]``.
        poses: ``T_world_from_camera [B, 4, 4]``.
        supersample: Rays along each side of a pixel.
        least: A ray is followed until less light than this remains.
        device: Where it is computed; arguments and results are on the CPU.
    """

    def __init__(self, placed: VoxelGridObject, nominal: VoxelGridObject, colours: Array, poses: Array, lens: Pinhole,
                 supersample: int, least: float, device: torch.device) -> None:  # fmt: skip
        self._field, self._lens, self._supersample, self._least = nominal, lens, supersample, least
        self._grid = TorchGrid(nominal, torch.float64, device)
        self._step_m = nominal.step_units * nominal.scale
        self._step_units = self._step_m / placed.scale
        there = (placement_of(placed), torch.from_numpy(colours), torch.from_numpy(poses))
        self._placement, self._colours, self._cameras = (each.to(device) for each in there)

    @torch.no_grad()
    def shade(self, pixels: NDArray[np.int64]) -> Array:
        """Red, green, blue, alpha and alpha-weighted depth of pixels, ``[P, 5]``."""
        shown = [self._shown(part, self._placement, self._colours).cpu() for part in self._parts(pixels)]
        return np.asarray(torch.cat([torch.zeros(0, 5, dtype=torch.float64), *shown]).numpy())

    def pull(self, pixels: NDArray[np.int64], slopes: Array, with_colours: bool) -> tuple[Array, Array]:
        """See `SoftLayer.pull`."""
        wanted = (self._placement, self._colours) if with_colours else (self._placement,)
        sums, parts = [torch.zeros_like(each) for each in wanted], self._parts(pixels)
        given = torch.from_numpy(slopes).to(self._placement).split([len(part) for part in parts])
        for part, slope in zip(parts, given, strict=True):
            with torch.enable_grad():
                leaves = [each.clone().requires_grad_() for each in wanted]
                shown = self._shown(part, leaves[0], leaves[1] if with_colours else self._colours)
                gradients = torch.autograd.grad((shown[:, :4] * slope).sum(), leaves)
            sums = [total + gradient for total, gradient in zip(sums, gradients, strict=True)]
        rows = sums[1].cpu().numpy() if with_colours else np.zeros((0, 3))
        return sums[0].cpu().numpy(), rows

    def _parts(self, pixels: NDArray[np.int64]) -> tuple[Tensor, ...]:
        there = torch.from_numpy(pixels).to(self._placement.device)
        return pixel_parts(there, self._field, self._step_units, self._supersample)

    def _shown(self, pixels: Tensor, placement: Tensor, colours: Tensor) -> Tensor:
        """``shade`` of a part, differentiable except in its depth."""
        image, aims = pixel_aims(pixels, self._lens, self._supersample)
        turn, position = pose_of(self._field, placement)
        edges, low = (
            torch.from_numpy(each).to(placement)
            for each in (voxel_edges(self._field), np.asarray(self._field.box_min, np.float64))
        )
        unit = edges * placement[3]
        o = ((self._cameras[:, :3, 3] - position) @ turn / unit - low / edges - 0.5)[image]
        d = (self._cameras[:, :3, :3][image] @ aims[..., None])[..., 0] @ turn / unit
        with torch.no_grad():
            t_in, t_out, _ = self._grid.span(o, d)
            first = (t_in / self._step_m - 0.5).ceil()
            count = (t_out / self._step_m - 0.5).ceil() - first
            count = torch.where((d[:, 0] >= 0.0) & self._field.one_sided, 0.0, count.clamp(min=0.0))
        dt, begin = torch.full_like(first, self._step_m), (first + 0.5) * self._step_m
        length = aims.norm(dim=1) * self._step_m / placement[3]
        seen = self._grid.look(o, d, begin, dt, count, length, self._least, last_takes_rest=False)
        colour = (seen.parts[..., None] * colours[self._grid.slots[seen.voxels]]).sum(1)
        t = (begin[seen.ray] + seen.row * self._step_m)[:, None]
        values = seen.weight[:, None] * torch.cat([colour, torch.ones_like(t), t], 1)
        return pixel_sums(seen, values, len(pixels), self._supersample)


def _window_pixels(field: VoxelGridObject, poses: Array, pinhole: Pinhole) -> NDArray[np.int64]:
    """Flat indices of the pixels that may show the object."""
    found = [np.zeros(0, np.int64)]
    for b, window in enumerate(windows(field, invert_transform(poses), pinhole)):
        v, u = np.mgrid[window[0] : window[1], window[2] : window[3]]
        found.append(((b * pinhole.height + v) * pinhole.width + u).ravel())
    return np.concatenate(found).astype(np.int64)
