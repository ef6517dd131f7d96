"""A textured mesh as an object of a surrogate: its texels are the free colours, and pixels are linear in them.

Geometry and camera are frozen, so one cast of rays gives the bilinear weights of every pixel, and with them the render and its exact
vector-Jacobian product, as for a voxel object (``render/cast_object``). Unlit: a pixel shows the texture.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.fields.sparse_rows import SparseRows
from advnerf_core.fields.voxel_grid import inverse_squash, squash
from advnerf_core.geometry import Array, Pinhole, invert_transform, transform_points
from advnerf_core.objects.mesh.ray_cast import Hits, RayCaster
from advnerf_core.objects.mesh.surface import TexturedMesh
from advnerf_core.render.cast_kernels import NEAR_M
from advnerf_core.render.cast_object import ObjectCast


@dataclass(frozen=True, eq=False)
class MeshField:
    """A mesh with a pose; a ``ColouredObject``.

    Attributes:
        mesh: Surface, texture coordinates and colours without an attack.
        T_world_from_object: Rigid pose ``[4, 4]``.
        scale: World metres per metre of the mesh.
        derived: Data computed once from the surface; shared by moved copies.
    """

    mesh: TexturedMesh
    T_world_from_object: Array
    scale: float = 1.0
    derived: dict[str, Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        T = np.asarray(self.T_world_from_object, dtype=np.float64)
        rigid = (
            T.shape == (4, 4)
            and np.isfinite(T).all()
            and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4)
        )
        if not rigid or not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(
                f"expected a rigid pose [4, 4] and a scale above zero, got {T.tolist()} and {self.scale}"
            )

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape of the texture."""
        return tuple(self.mesh.texture.shape)

    @property
    def parameter_count(self) -> int:
        """Number of texels."""
        return int(self.mesh.charts.size)

    free_count = slot_count = parameter_count

    @property
    def fixed_colours(self) -> Array:
        """None: all texels are free."""
        return np.zeros((0, 3))

    @property
    def mixing(self) -> None:
        """None: a texel is one parameter."""

    @cached_property
    def plain_theta(self) -> Array:
        """The texture before the squash, ``[texels, 3]``."""
        return inverse_squash(self.mesh.texture.reshape(-1, 3))

    def check_theta(self, theta: Tensor) -> None:
        """Raise ``ValueError`` unless ``theta`` has the texture's shape."""
        if tuple(theta.shape) != self.theta_shape:
            raise ValueError(f"expected theta of shape {self.theta_shape}, got {tuple(theta.shape)}")

    def colours(self, theta: Tensor) -> Tensor:
        """Colours of the texels ``[texels, 3]``; with autograd history."""
        self.check_theta(theta)
        return squash(theta.reshape(-1, 3))

    def texture(self, theta: Tensor) -> NDArray[np.float32]:
        """The texture ``[H, W, 3]`` of ``theta``; texels outside all charts keep their plain colour."""
        colours = self.colours(theta.detach()).numpy().reshape(self.theta_shape)
        return np.where(self.mesh.charts[..., None] >= 0, colours, self.mesh.texture).astype(np.float32)

    def neighbours(self) -> NDArray[np.int64]:
        """Pairs ``[P, 2]`` of texels next to each other in one chart."""
        charts, number = self.mesh.charts, np.arange(self.mesh.charts.size).reshape(self.mesh.charts.shape)
        pairs = []
        for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            same = (charts[here] == charts[there]) & (charts[here] >= 0)
            pairs.append(np.stack([number[here][same], number[there][same]], axis=1))
        return np.concatenate(pairs).astype(np.int64)

    def moved(self, T_world_from_object: ArrayLike, scale: float | None = None) -> MeshField:
        """The same object at another pose, and with another scale if one is given."""
        pose = np.asarray(T_world_from_object, dtype=np.float64)
        other = replace(self, T_world_from_object=pose, scale=self.scale if scale is None else scale)
        object.__setattr__(other, "derived", self.derived)
        return other

    @property
    def sha256(self) -> str:
        """Hash of geometry, texture coordinates and pose, and of no colours, which a texture attack searches."""
        digest = hashlib.sha256(repr((self.theta_shape, self.scale)).encode())
        for part in (self.mesh.vertices, self.mesh.faces, self.mesh.texels, self.T_world_from_object):
            digest.update(np.ascontiguousarray(part).tobytes())
        return digest.hexdigest()

    def cast(self, T_world_from_camera: Array, pinhole: Pinhole, supersample: int, dtype: Any) -> ObjectCast:
        """Cast into cameras ``[B, 4, 4]``: pixels, coverage, planar depth and bilinear weights of the texels."""
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        rays = [self._rays(pose, pinhole, supersample) for pose in poses]
        area = pinhole.height * pinhole.width
        pixels = np.concatenate([np.zeros(0, np.int64), *(part[0] + b * area for b, part in enumerate(rays))])
        origins, directions = (
            np.concatenate([np.zeros((0, 3)), *(part[k] for part in rays)]) for k in (1, 2)
        )
        if "rays" not in self.derived:
            self.derived["rays"] = RayCaster(self.mesh)
        hits = self.derived["rays"].cast(origins, directions)
        return self._gathered(pixels[hits.rays], hits, supersample**2, dtype)

    def _rays(
        self, T_world_from_camera: Array, pinhole: Pinhole, supersample: int
    ) -> tuple[NDArray[np.int64], Array, Array]:
        """Pixels, origins and directions of unit planar depth, in the mesh's frame, through the pixels that may see it."""
        window = self.window(T_world_from_camera, pinhole)
        if window is None:
            return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))
        top, bottom, left, right = window
        pixels, directions = _grid(pinhole, supersample)
        seen = directions[top:bottom, left:right].reshape(-1, 3)
        T = invert_transform(self.T_world_from_object) @ T_world_from_camera
        origin = np.broadcast_to(T[:3, 3] / self.scale, seen.shape)
        return pixels[top:bottom, left:right].reshape(-1), origin, seen @ (T[:3, :3].T / self.scale)

    def window(self, T_world_from_camera: Array, pinhole: Pinhole) -> tuple[int, int, int, int] | None:
        """Rows and columns that surely contain the mesh; None if it is out of sight, or the pose is not finite."""
        if not np.isfinite(T_world_from_camera).all():
            return None
        low, high = self.mesh.box
        unit = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
        corners = self.scale * (low + unit * (high - low)) @ self.T_world_from_object[:3, :3].T
        seen = transform_points(
            invert_transform(T_world_from_camera), corners + self.T_world_from_object[:3, 3]
        )
        if not (seen[:, 2] > NEAR_M).any():
            return None
        if not (seen[:, 2] > NEAR_M).all():
            return 0, pinhole.height, 0, pinhole.width
        uv = pinhole.project(seen)
        (left, top), (right, bottom) = (
            np.floor(uv.min(axis=0)).astype(int),
            np.ceil(uv.max(axis=0)).astype(int),
        )
        top, bottom = max(top, 0), min(bottom, pinhole.height)
        left, right = max(left, 0), min(right, pinhole.width)
        return (top, bottom, left, right) if bottom > top and right > left else None

    def _gathered(self, pixel: NDArray[np.int64], hits: Hits, rays_per_pixel: int, dtype: Any) -> ObjectCast:
        """One row per pixel with the hits of its rays; rays of a pixel are consecutive."""
        pixels, first, counts = np.unique(pixel, return_index=True, return_counts=True)
        texel, weight = self._bilinear(hits)
        ends = np.concatenate([[0], np.cumsum(4 * counts)]).astype(np.int32)
        data = (weight / rays_per_pixel).astype(dtype).reshape(-1)
        depth = np.add.reduceat(hits.t, first) / counts if len(pixels) else np.zeros(0)
        return ObjectCast(
            pixels,
            counts / rays_per_pixel,
            depth,
            SparseRows(ends, texel.reshape(-1), data, self.slot_count),
        )

    def _bilinear(self, hits: Hits) -> tuple[NDArray[np.int32], Array]:
        """The four texels around each hit ``[N, 4]`` and their weights."""
        height, width = self.mesh.charts.shape
        where = np.einsum("nk,nkc->nc", hits.weights, self.mesh.texels[hits.faces]) - 0.5
        column, row = np.clip(where[:, 0], 0, width - 1), np.clip(where[:, 1], 0, height - 1)
        left, top = np.floor(column).astype(np.int32), np.floor(row).astype(np.int32)
        right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        x, y = column - left, row - top
        texels = np.stack(
            [top * width + left, top * width + right, bottom * width + left, bottom * width + right], axis=-1
        )
        weights = np.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x], axis=-1)
        return texels.astype(np.int32), weights


@lru_cache(maxsize=4)
def _grid(pinhole: Pinhole, supersample: int) -> tuple[NDArray[np.int64], Array]:
    """Pixel ``[H, W, s, s]`` and direction ``[H, W, s, s, 3]`` of all rays of a camera."""
    fine = pinhole.resized(pinhole.width * supersample, pinhole.height * supersample).directions()
    shape = (pinhole.height, supersample, pinhole.width, supersample)
    directions = np.ascontiguousarray(fine.reshape(*shape, 3).swapaxes(1, 2))
    number = np.arange(pinhole.height * pinhole.width).reshape(pinhole.height, pinhole.width, 1, 1)
    pixels = np.ascontiguousarray(np.broadcast_to(number, directions.shape[:-1]))
    directions.setflags(write=False)
    return pixels, directions
