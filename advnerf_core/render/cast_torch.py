"""Voxel-grid objects in plain torch, on any device: drawn into images, and differentiated with respect to colours and placements.

Samples and rules are those of ``cast_kernels`` and ``pose_kernels``. All rays of a part of the image are evaluated together; samples in
empty cells are left out. Sums along a ray run down the first axis of ``[samples, rays]``, and gradients are sums of whole numbers or sorted
sums, so results have the same bits every time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from advnerf_core.errors import DeviceError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, Pinhole, invert_transform
from advnerf_core.render.cast_kernels import LEAST_TRANSMITTANCE, NEAR_M
from advnerf_core.render.cast_object import prepared, windows
from advnerf_core.render.composite import visible_shares

_AT_ONCE = 1 << 20  # samples evaluated together, at about 200 bytes each
_SUM_BITS = 62  # 64-bit whole numbers hold the sum of all pixels' slopes with a bit to spare


def voxel_objects(objects: Sequence[ColouredObject]) -> list[VoxelGridObject]:
    """The objects, if a GPU can draw all of them.

    Raises:
        DeviceError: An object is not a voxel grid.
    """
    grids = [field for field in objects if isinstance(field, VoxelGridObject)]
    if len(grids) != len(objects):
        other = next(type(field).__name__ for field in objects if not isinstance(field, VoxelGridObject))
        raise DeviceError(f"expected objects made of voxels on a GPU, got a {other}; search on the processor")
    return grids


def voxel_edges(field: VoxelGridObject) -> Array:
    """Object units per voxel along each axis ``[3]``."""
    edges: Array = (np.asarray(field.box_max, np.float64) - field.box_min) / field.slots.shape
    return edges


def sum_of_slopes(slopes: Tensor, pull: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """A gradient summed in whole numbers, whose order does not matter; NaN if a slope is not finite.

    Args:
        slopes: With respect to the images ``[B, 3, H, W]``.
        pull: Takes finite slopes and the value of one in whole numbers ``[1]`` float64; returns the gradient in whole numbers.
    """
    largest = slopes.abs().max().double()
    slopes = slopes.nan_to_num(0.0, 0.0, 0.0).contiguous()  # NaN is restored at the end
    # No sum over all pixels reaches the largest whole number, as a pixel's weights sum to at most one.
    bits = _SUM_BITS - (slopes.numel() // 3).bit_length()
    scale = (2.0**bits / largest.clamp(1e-200, 1e200)).reshape(1)
    gradient = pull(slopes, scale).double() / scale
    return torch.where(torch.isfinite(largest), gradient, torch.nan).to(slopes.dtype)


def trilinear(share: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets of the eight corners of a cell with steps ``[S, 3]`` between its faces, and the parts of each at ``share [S, 3]``; ``[S, 8]``."""
    high = (torch.arange(8, device=share.device)[:, None] >> torch.arange(3, device=share.device) & 1).bool()
    part = torch.where(high, share[:, None], 1.0 - share[:, None])
    return torch.where(high, step[:, None], 0).sum(2), part[..., 0] * part[..., 1] * part[..., 2]


class SeenSamples(NamedTuple):
    """Visible samples of rays: row and ray ``[S]``, weight ``[S]``, voxels around them ``[S, 8]`` and the trilinear parts of these."""

    row: Tensor
    ray: Tensor
    weight: Tensor
    voxels: Tensor
    parts: Tensor


class TorchGrid:
    """The voxels of one object on a device."""

    def __init__(self, field: VoxelGridObject, dtype: torch.dtype, device: torch.device) -> None:
        grids = prepared(field, torch.empty(0, dtype=dtype).numpy().dtype)
        self.field, self.device = field, device
        self.size = torch.tensor(field.slots.shape, device=device)
        self.slots = torch.from_numpy(grids.slots).to(device).reshape(-1).long()
        self.clear = torch.from_numpy(grids.clear).to(device).reshape(-1)
        density = torch.from_numpy(grids.density).to(device).reshape(-1)
        self.density = None if field.density is None else density

    def span(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Planar depths of entry and exit of rays ``[R, 3]`` in voxel coordinates, and whether the entry is through the ``+x`` face.

        A ray that misses has its exit before its entry.
        """
        high = self.size.to(d.dtype) - 0.5
        along = d.abs() < 1e-15
        a, b = (-0.5 - o) / d, (high - o) / d
        first = torch.where(along, -torch.inf, torch.minimum(a, b))
        last = torch.where(along, torch.inf, torch.maximum(a, b)).amin(1)
        beside = (along & ((o < -0.5) | (o > high))).any(1)
        by_face = (d[:, 0] < 0.0) & (first[:, 0] > NEAR_M) & (first[:, 0] >= first[:, 1:].amax(1))
        return first.amax(1).clamp(min=NEAR_M), torch.where(beside, 0.0, last), by_face

    def look(self, o: Tensor, d: Tensor, begin: Tensor, dt: Tensor, count: Tensor, length: Tensor, least: float,
             last_takes_rest: bool) -> SeenSamples:  # fmt: skip
        """March rays ``[R, 3]``, whose samples ``i < count`` lie at ``begin + i dt`` and are ``length`` object units long, all ``[R]``.

        A ray ends where less light than ``least`` remains; its last sample takes that rest, or leaves it.
        """
        rows = torch.arange(int(count.max()) if len(count) else 0, device=self.device)[:, None]
        wanted = rows < count
        if self.density is not None:
            with torch.no_grad():
                cells = (self.size - 1).clamp(min=1)
                at = torch.addcmul(o, (begin + rows * dt)[..., None], d).floor().long()
                at = torch.minimum(at, cells - 1).clamp(min=0)
                wanted &= self.clear[(at[..., 0] * cells[1] + at[..., 1]) * cells[2] + at[..., 2]] == 0
        row, ray = wanted.nonzero(as_tuple=True)
        voxels, parts = self._around(o[ray] + (begin[ray] + row * dt[ray])[:, None] * d[ray])
        if self.density is None:
            depth = torch.full_like(parts[:, 0], torch.inf)
        else:
            depth = (parts * self.density[voxels].to(parts.dtype)).sum(1).clamp(min=0.0) * length[ray]
        dense = torch.zeros(wanted.shape, dtype=o.dtype, device=self.device).index_put((row, ray), depth)
        after = torch.exp(-torch.cumsum(dense, 0))
        before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
        weight = before - after
        if last_takes_rest:
            weight = torch.where(after < least, before, weight)
        weight = (weight * ((before >= least) & (dense > 0.0)))[row, ray]
        kept = (weight > 0.0).nonzero()[:, 0]
        return SeenSamples(row[kept], ray[kept], weight[kept], voxels[kept], parts[kept])

    def _around(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Voxels around positions ``[S, 3]``, flat ``[S, 8]``, and their trilinear parts, which are differentiable."""
        last = self.size - 1
        stride = torch.stack([self.size[1] * self.size[2], self.size[2], torch.ones_like(last[0])])
        low = torch.minimum(x.detach().floor().long(), last - 1).clamp(min=0)
        share = torch.minimum(x.clamp(min=0.0), last.to(x.dtype)) - low
        beyond, part = trilinear(share, (torch.minimum(low + 1, last) - low) * stride)
        return (low * stride).sum(1)[:, None] + beyond, part


def pixel_aims(pixels: Tensor, lens: Pinhole, supersample: int) -> tuple[Tensor, Tensor]:
    """Image of each ray ``[R]`` of flat pixels of ``[B, H, W]``, and its direction of unit planar depth in the camera ``[R, 3]``."""
    inner = torch.arange(supersample**2, dtype=torch.float64, device=pixels.device)
    u = (pixels % lens.width)[:, None] + (inner % supersample + 0.5) / supersample
    v = (pixels // lens.width % lens.height)[:, None] + ((inner / supersample).floor() + 0.5) / supersample
    aims = torch.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, torch.ones_like(u)], -1)
    image = pixels // (lens.width * lens.height)
    return image.repeat_interleave(len(inner)), aims.reshape(-1, 3)


def pixel_sums(seen: SeenSamples, values: Tensor, pixels: int, supersample: int) -> Tensor:
    """Sums of values of samples ``[S, C]`` along the rays of each pixel, averaged over its rays ``[pixels, C]``."""
    rows = int(seen.row.max()) + 1 if len(seen.row) else 0
    dense = values.new_zeros(rows, pixels * supersample**2, values.shape[1])
    rays = dense.index_put((seen.row, seen.ray), values).sum(0)
    return rays.view(pixels, supersample**2, -1).mean(1) if pixels else rays


def pixel_parts(
    pixels: Tensor, field: VoxelGridObject, step_units: float, supersample: int
) -> tuple[Tensor, ...]:
    """Pixels in parts whose rays have about `_AT_ONCE` samples, ``step_units`` apart at least."""
    across = float(np.linalg.norm(np.asarray(field.box_max, np.float64) - field.box_min))
    samples = 1 if field.density is None else math.ceil(across / step_units) + 1
    return pixels.split(max(1, _AT_ONCE // (samples * supersample**2))) if len(pixels) else ()


class TorchObjects:
    """Objects at fixed places, drawn and differentiated on any device.

    Args:
        objects: At least one, all voxel grids.
        supersample: Rays along each side of a pixel.
        dtype: Type of densities and images; geometry is float64 in any case.
        tolerance_m: Distance behind the background at which an object is still visible [m].

    Raises:
        DeviceError: An object is not a voxel grid.
    """

    def __init__(self, objects: Sequence[ColouredObject], pinhole: Pinhole, supersample: int, dtype: torch.dtype, tolerance_m: float,
                 device: torch.device) -> None:  # fmt: skip
        self.objects, self.device, self.dtype = voxel_objects(objects), device, dtype
        self._pinhole, self._supersample, self._tolerance_m = pinhole, supersample, tolerance_m
        self._grids = [TorchGrid(field, dtype, device) for field in self.objects]
        self._first = np.cumsum([0, *(field.slot_count for field in self.objects)]).tolist()

    def placed(self, T_world_from_camera: Array) -> tuple[Tensor, Tensor]:
        """Places of the objects for cameras ``[B, 4, 4]``.

        Returns:
            Directions of unit planar depth in each camera to voxel coordinates, row by row, then the camera's centre there ``[K, B, 12]``;
            and first row, end row, first column, end column of the pixels that may show each object ``[K, B, 4]``.
        """
        T_camera_from_world = invert_transform(T_world_from_camera)
        frames = np.empty((len(self.objects), len(T_world_from_camera), 12))
        seen = np.empty((*frames.shape[:2], 4), np.int32)
        for k, field in enumerate(self.objects):
            edges = voxel_edges(field)
            T = invert_transform(field.T_world_from_object) @ T_world_from_camera
            frames[k, :, :9] = (T[:, :3, :3] / field.scale / edges[:, None]).reshape(-1, 9)
            frames[k, :, 9:] = (T[:, :3, 3] / field.scale - field.box_min) / edges - 0.5
            seen[k] = windows(field, T_camera_from_world, self._pinhole)
        return torch.from_numpy(frames).to(self.device), torch.from_numpy(seen).to(self.device)

    def draw(self, places: tuple[Tensor, Tensor], colours: Tensor, texture_of: Tensor, behind_m: Tensor,
             image: Tensor) -> Tensor:  # fmt: skip
        """Draw into ``image [B, 3, H, W]``, a background of planar depth ``behind_m [B, H, W]``.

        Args:
            colours: All objects' colour vectors in their order, for each texture ``[N, V, 3]``.
            texture_of: Index of each image's texture ``[B]`` int32.
            behind_m: Planar depth of the background ``[B, H, W]`` [m].
            image: Background, which is drawn into.

        Returns:
            Share of each object in each pixel ``[K, B, H, W]``.
        """
        count, area = len(self._grids), behind_m[0].numel()
        layers = torch.zeros(count, behind_m.numel(), 5, dtype=torch.float64, device=self.device)
        v, u = (torch.arange(n, device=self.device) for n in behind_m.shape[1:])
        for k, window in enumerate(places[1]):
            low_v, high_v, low_u, high_u = window.T[..., None]
            rows, columns = (v >= low_v) & (v < high_v), (u >= low_u) & (u < high_u)
            inside = (rows[:, :, None] & columns[:, None]).flatten().nonzero()[:, 0]
            for pixels, seen, t in self._marched(k, places[0][k], inside):
                texture = texture_of[pixels // area].repeat_interleave(self._supersample**2)[seen.ray].long()
                shown = colours[texture[:, None], self._first[k] + self._grids[k].slots[seen.voxels]]
                colour = (seen.parts[..., None] * shown).sum(1)
                values = seen.weight[:, None] * torch.cat([colour, torch.ones_like(t), t], 1)
                layers[k, pixels] = pixel_sums(seen, values, len(pixels), self._supersample)
        alpha = layers[..., 3].clamp(max=1.0).view(count, *behind_m.shape)
        nearest = (layers[..., 4] / layers[..., 3]).view_as(alpha).nan_to_num(torch.inf) - self._tolerance_m
        shown_here = (alpha > 0.0) & ~(nearest > behind_m)  # NaN hides nothing
        alpha = torch.where(shown_here, alpha, 0.0)
        shares = torch.where(shown_here, visible_shares(alpha, nearest), 0.0)
        drawn = (shares[..., None] * layers[..., :3].view(*alpha.shape, 3)).sum(0).permute(0, 3, 1, 2)
        image.copy_(image * (1.0 - alpha).prod(0)[:, None] + drawn)
        return shares.to(self.dtype)

    def pull(self, places: tuple[Tensor, Tensor], colours: Tensor, texture_of: Tensor, shares: Tensor,
             slopes: Tensor) -> Tensor:  # fmt: skip
        """Gradient with respect to ``colours [N, V, 3]`` from one with respect to the images ``[B, 3, H, W]``; the same bits every time."""
        return sum_of_slopes(slopes, partial(self._pull, places[0], colours, texture_of, shares))

    def _pull(self, frames: Tensor, colours: Tensor, texture_of: Tensor, shares: Tensor, slopes: Tensor,
              scale: Tensor) -> Tensor:  # fmt: skip
        total = torch.zeros(colours.shape, dtype=torch.int64, device=self.device).view(-1, 3)
        area, inner = slopes[0, 0].numel(), self._supersample**2
        flat = slopes.permute(0, 2, 3, 1).reshape(-1, 3)
        for k, grid in enumerate(self._grids):
            share = shares[k].flatten()
            for pixels, seen, _ in self._marched(k, frames[k], (share > 0.0).nonzero()[:, 0]):
                pixel = pixels[seen.ray // inner]
                own = flat[pixel].double() * (share[pixel] * scale / inner * seen.weight)[:, None]
                slot = grid.slots[seen.voxels]
                row = texture_of[pixel // area].long()[:, None] * colours.shape[1] + self._first[k] + slot
                free = slot < grid.field.free_count
                added = (seen.parts[..., None] * own[:, None]).to(torch.int64)
                total.index_add_(0, row[free], added[free])
        return total.view(colours.shape)

    def _marched(
        self, k: int, frames: Tensor, pixels: Tensor
    ) -> Iterator[tuple[Tensor, SeenSamples, Tensor]]:
        """Pixels in parts, the visible samples of their rays through object ``k``, and the planar depths ``[S, 1]`` of these."""
        field, grid = self.objects[k], self._grids[k]
        edges = torch.from_numpy(voxel_edges(field)).to(self.device)
        for part in pixel_parts(pixels, field, field.step_units, self._supersample):
            image, aims = pixel_aims(part, self._pinhole, self._supersample)
            o, d = frames[image, 9:], (frames[image, :9].view(-1, 3, 3) @ aims[..., None])[..., 0]
            t_in, t_out, by_face = grid.span(o, d)
            hit = (t_out > t_in) & (by_face | (not field.one_sided))
            speed = (d * edges).norm(dim=1)
            solid = grid.density is None
            step = torch.inf if solid else field.step_units
            count = ((t_out - t_in) * speed / step).ceil().clamp(min=1.0)
            dt = (t_out - t_in) / count
            begin = t_in if solid else t_in + 0.5 * dt
            count = torch.where(hit, count, 0.0)
            seen = grid.look(o, d, begin, dt, count, dt * speed, LEAST_TRANSMITTANCE, last_takes_rest=True)
            yield part, seen, (begin[seen.ray] + seen.row * dt[seen.ray])[:, None]
