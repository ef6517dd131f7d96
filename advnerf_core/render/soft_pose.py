"""Renders of voxel-grid objects that are differentiable with respect to where the objects stand: position, yaw and scale.

Where an object's density is soft, a picture changes smoothly as the object moves. Here rays are sampled at depths that do not depend
on the placement, so that the sum which makes the picture is a smooth function of it, and autograd gives its exact derivative.
Which samples to look at (those in cells that are not empty, until nearly no light is left) is found first and held. Not
differentiated: which of two layers is nearer, and edges of a solid without density, which have no derivative.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, Pinhole, invert_transform, rotation_z, yaw_of
from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.cast_kernels import NEAR_M, cell_of, share_of, span_in_box, steps_to_leap
from advnerf_core.render.cast_object import prepared, windows

LEAST_TRANSMITTANCE = 1e-4


def placement_of(field: VoxelGridObject) -> Tensor:
    """Where an object stands: ``(x_m, y_m, yaw_rad, scale)``, float64."""
    T = field.T_world_from_object
    return torch.tensor([T[0, 3], T[1, 3], yaw_of(T), field.scale], dtype=torch.float64)


def pose_of(field: VoxelGridObject, placement: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation ``[3, 3]`` and position ``[3]`` of an object placed at ``(x_m, y_m, yaw_rad, scale)``; it keeps height and tilt."""
    tilt = torch.tensor(rotation_z(-yaw_of(field.T_world_from_object)) @ field.T_world_from_object[:3, :3]).to(
        placement
    )
    x, y, yaw = placement[0], placement[1], placement[2]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    turn = torch.stack([yaw.cos(), -yaw.sin(), zero, yaw.sin(), yaw.cos(), zero, zero, zero, one]).reshape(3, 3)
    return turn @ tilt, torch.stack([x, y, zero + float(field.T_world_from_object[2, 3])])


def placed_at(field: VoxelGridObject, placement: Tensor) -> VoxelGridObject:
    """The object at ``(x_m, y_m, yaw_rad, scale)``, without history."""
    R, t = pose_of(field, placement.detach().double())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.numpy(), t.numpy()
    return field.moved(T, float(placement.detach()[3]))


def render_soft(
    field: VoxelGridObject,
    placement: Tensor,
    theta: Tensor,
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole,
    supersample: int = 2,
    least_transmittance: float = LEAST_TRANSMITTANCE,
) -> tuple[Tensor, Tensor, Tensor]:
    """One object, differentiable with respect to its placement and its colours.

    Args:
        field: The object; must have a density.
        placement: ``(x_m, y_m, yaw_rad, scale)`` ``[4]``, float64, finite, with a positive scale.
        theta: Its parameters.
        T_world_from_camera: ``[B, 4, 4]``.
        pinhole: Intrinsics.
        supersample: Rays along each side of a pixel.
        least_transmittance: A ray is followed until so little light is left.

    Returns:
        Premultiplied colours ``[B, H, W, 3]``, alpha ``[B, H, W]`` and planar depth ``[B, H, W]`` [m] (infinite where nothing is),
        all float64; depth has no history.
    """
    if field.density is None:
        raise ValueError("expected an object with a density, got an opaque solid: its edges have no derivative")
    if placement.shape != (4,) or not bool(torch.isfinite(placement).all()) or float(placement.detach()[3]) <= 0:
        raise ValueError(f"expected a finite placement (x, y, yaw, scale) with scale > 0, got {placement.tolist()}")
    poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    placement = placement.double()
    rays, rows, depths = _samples(placed_at(field, placement), poses, pinhole, supersample, least_transmittance, field)
    centres, directions, pixels = (torch.from_numpy(part) for part in rays)
    row, t = torch.from_numpy(rows), torch.from_numpy(depths)
    R, position = pose_of(field, placement)
    scale = placement[3]
    points = ((centres[row] + t[:, None] * directions[row] - position) @ R) / scale
    values = _grid_values(field, theta.double(), points)
    step_m = field.step_units * field.scale
    tau = values[:, 0] * step_m * directions[row].norm(dim=1) / scale
    weights = _weights(tau, row) / supersample**2
    count = len(poses) * pinhole.height * pinhole.width
    pixel = pixels[row]
    shape = (len(poses), pinhole.height, pinhole.width)
    colour = torch.zeros(count, 3, dtype=torch.float64).index_add(0, pixel, weights[:, None] * values[:, 1:])
    alpha = torch.zeros(count, dtype=torch.float64).index_add(0, pixel, weights)
    reach = torch.zeros(count, dtype=torch.float64).index_add(0, pixel, weights.detach() * t)
    depth = torch.where(alpha > 0, reach / alpha.detach().clamp_min(1e-300), torch.inf)
    return colour.reshape(*shape, 3), alpha.reshape(shape), depth.detach().reshape(shape)


def _grid_values(field: VoxelGridObject, theta: Tensor, points: Tensor) -> Tensor:
    """Density and colours ``[N, 4]`` at points in object units."""
    low, high = (torch.as_tensor(np.asarray(corner, np.float64)) for corner in (field.box_min, field.box_max))
    colours = field.colours(theta)[torch.from_numpy(np.asarray(field.slots, np.int64))]
    density = torch.from_numpy(np.asarray(field.density, np.float64))
    grid = torch.cat([density[..., None], colours], dim=-1).permute(3, 0, 1, 2)
    where = (2.0 * (points - low) / (high - low) - 1.0).flip(-1)
    out = grid_sample(grid[None], where[None, None, None], mode="bilinear", padding_mode="border", align_corners=False)
    return out[0, :, 0, 0].T


def _weights(tau: Tensor, row: Tensor) -> Tensor:
    """Rendering weights of samples, given ray by ray in order, of their optical depths."""
    total = tau.cumsum(0)
    first = (
        torch.cat([torch.ones(1, dtype=torch.bool), row[1:] != row[:-1]])
        if len(row)
        else torch.zeros(0, dtype=torch.bool)
    )
    before = (total - tau)[first][first.long().cumsum(0) - 1]
    passed = total - before
    return torch.exp(-(passed - tau)) * -torch.expm1(-tau)


def _samples(field: VoxelGridObject, poses: Array, pinhole: Pinhole, supersample: int, least: float,
             nominal: VoxelGridObject) -> tuple[tuple[Any, Any, Any], NDArray[np.int64], Array]:  # fmt: skip
    """Rays (centres, directions of unit planar depth, pixels), and per sample its ray and planar depth, ray by ray."""
    centres, directions, pixels, owners, depths = [], [], [], [], []
    grids, before = prepared(field, np.float64), 0
    edges = (np.asarray(field.box_max, np.float64) - field.box_min) / grids.slots.shape
    for b, (T, window) in enumerate(zip(poses, windows(field, poses, pinhole), strict=True)):
        v, u = np.mgrid[window[0] : window[1], window[2] : window[3]]
        inner = (np.arange(supersample) + 0.5) / supersample
        x = (u[..., None, None] + inner[None, :] - pinhole.cx) / pinhole.fx
        y = (v[..., None, None] + inner[:, None] - pinhole.cy) / pinhole.fy
        x, y = np.broadcast_arrays(x, y)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ T[:3, :3].T
        to_object = invert_transform(field.T_world_from_object)
        d = rays @ to_object[:3, :3].T / field.scale / edges
        o = ((to_object @ T)[:3, 3] / field.scale - field.box_min) / edges - 0.5
        step_m = nominal.step_units * nominal.scale
        # How much a metre of planar depth counts against an extinction per object unit.
        lengths = np.linalg.norm(rays, axis=1) * step_m / field.scale
        need = _walk(d, o, grids.density, grids.clear, step_m, lengths, least, np.zeros(0, np.int64), np.zeros(0))
        owner, depth = np.empty(need, np.int64), np.empty(need)
        _walk(d, o, grids.density, grids.clear, step_m, lengths, least, owner, depth)
        centres.append(np.broadcast_to(T[:3, 3], rays.shape))
        directions.append(rays)
        pixels.append(np.repeat((b * pinhole.height + v.ravel()) * pinhole.width + u.ravel(), supersample**2))
        owners.append(owner + before)
        depths.append(depth)
        before += len(rays)
    kept = (np.concatenate(centres), np.concatenate(directions), np.concatenate(pixels).astype(np.int64))
    return kept, np.concatenate(owners), np.concatenate(depths)


@njit(**KERNEL_OPTIONS)
def _walk(
    d: Any, o: Any, density: Any, clear: Any, step_m: float, lengths: Any, least: float, owner: Any, depth: Any
) -> int:
    """Samples at multiples of ``step_m`` in cells that are not empty; counts them, and writes as many as there is room for."""
    nx, ny, nz = density.shape
    count = 0
    for r in range(len(d)):
        t_in, t_out, _ = span_in_box(o, d[r], density.shape, NEAR_M)
        if t_out <= t_in:
            continue
        k, light = int(np.ceil(t_in / step_m - 0.5)), 1.0
        while (k + 0.5) * step_m < t_out:
            t = (k + 0.5) * step_m
            x, y, z = o[0] + t * d[r, 0], o[1] + t * d[r, 1], o[2] + t * d[r, 2]
            cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
            reach = int(clear[cx, cy, cz])
            if reach > 0:
                leap = min(
                    steps_to_leap(x, step_m * d[r, 0], cx, reach),
                    steps_to_leap(y, step_m * d[r, 1], cy, reach),
                    steps_to_leap(z, step_m * d[r, 2], cz, reach),
                )
                k += max(leap, 1)
                continue
            if count < len(owner):
                owner[count], depth[count] = r, t
            count += 1
            fx, fy, fz = share_of(x, cx, nx), share_of(y, cy, ny), share_of(z, cz, nz)
            sigma = 0.0
            for corner in range(8):
                ax = min(cx + (corner & 1), nx - 1)
                ay = min(cy + ((corner >> 1) & 1), ny - 1)
                az = min(cz + (corner >> 2), nz - 1)
                share = (
                    (fx if corner & 1 else 1.0 - fx)
                    * (fy if corner & 2 else 1.0 - fy)
                    * (fz if corner & 4 else 1.0 - fz)
                )
                sigma += share * density[ax, ay, az]
            light *= np.exp(-sigma * lengths[r])
            if light < least:
                break
            k += 1
    return count
