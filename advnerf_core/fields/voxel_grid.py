"""Object fields: a decoder-less, view-independent voxel grid whose squashed colours are interpolated trilinearly.

The free parameters of an object, ``theta``, are colour-grid values before squashing. The squash (a sigmoid) is applied to
grid values *before* interpolation, so with frozen geometry every pixel is linear in the squashed grid: rendering is one
sparse matrix product and its vector-Jacobian product is the transpose of the same matrix (see ``render/cast_object``).

Voxels share parameters through ``slots``: each voxel names the row of the colour vector ``[squash(theta); fixed]`` it shows.
This keeps a face several voxels deep one texture, and parts that are not deployed plain.

Object frame of a face object: origin at the centre of the deployed face, x its outward normal, z up, y = z cross x. A viewer
in front of the face sees texture row 0 at the top and column 0 at the left, which is at the smallest y.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import lsqr
from torch import Tensor

from advnerf_core.geometry import Array

# The inverse squash of exactly 0 or 1 is infinite; half an 8-bit step is as far as a display can show.
_SATURATION = 0.5 / 255.0


@dataclass(frozen=True, eq=False)
class VoxelGridObject:
    """A box of voxels with a pose. Voxel values sit at voxel centres and are clamped at the border of the box.

    Attributes:
        slots: Row of the colour vector that each voxel shows, ``[nx, ny, nz]`` int32.
        theta_shape: Shape ``[..., 3]`` of the free parameters; its leading sizes multiply to the number of free rows.
        fixed_colours: Colours of the rows after the free ones, ``[F, 3]`` in 0..1 (F may be 0).
        box_min: Corner of the box in object units, ``[3]``.
        box_max: Opposite corner, ``[3]``.
        T_world_from_object: Rigid pose ``[4, 4]``.
        scale: World metres per object unit; ``sigma * length`` is taken in object units.
        density: Extinction at voxel centres per object unit, ``[nx, ny, nz]``; negative values after interpolation are empty, so that a
            surface can lie anywhere between voxel centres. None is an opaque solid box (the limit of infinite density: one sample
            where the ray enters).
        one_sided: Only rays that enter through the ``+x`` face hit, as for a projected or displayed texture, which has
            a front and no sides.
        step_units: Length of a ray-marching step in object units; used with a density only.
        plain_colours: Colours of the free rows without an attack, ``[free_count, 3]`` in 0..1; None is the mean of the fixed
            ones.
        mixing: Free rows as sums of parameters before the squash, ``[free_count, parameter_count]``; None is the identity. It
            is how summed levels (``fields/summed_levels``) keep a picture linear in the squashed colours.
        derived: Data that renderers computed from slots and density; shared by moved copies.
    """

    slots: NDArray[np.int32]
    theta_shape: tuple[int, ...]
    fixed_colours: Array
    box_min: Array
    box_max: Array
    T_world_from_object: Array
    scale: float = 1.0
    density: Array | None = None
    one_sided: bool = False
    step_units: float = 0.01
    plain_colours: Array | None = None
    mixing: sparse.csr_matrix | None = None
    derived: dict[Any, Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes and ranges, so that the casting kernel may index unchecked."""
        if self.slots.ndim != 3 or self.slots.dtype != np.int32:
            raise ValueError(
                f"expected slots [nx, ny, nz] of int32, got {self.slots.shape} of {self.slots.dtype}"
            )
        if self.theta_shape[-1] != 3:
            raise ValueError(f"expected theta_shape to end in 3 colour channels, got {self.theta_shape}")
        if self.slots.min() < 0 or self.slots.max() >= self.slot_count:
            raise ValueError(
                f"expected slots in 0..{self.slot_count - 1}, got {self.slots.min()}..{self.slots.max()}"
            )
        if not (np.asarray(self.box_max) > np.asarray(self.box_min)).all():
            raise ValueError(f"expected box_max above box_min, got {self.box_min} and {self.box_max}")
        if self.density is not None and self.density.shape != self.slots.shape:
            raise ValueError(
                f"expected a density of shape {self.slots.shape}, got shape {self.density.shape}"
            )
        if self.mixing is not None and self.mixing.shape[1] != self.parameter_count:
            raise ValueError(f"expected mixing of {self.parameter_count} parameters, got {self.mixing.shape}")
        if self.plain_colours is not None and self.plain_colours.shape != (self.free_count, 3):
            raise ValueError(f"expected plain_colours {(self.free_count, 3)}, got {self.plain_colours.shape}")
        if self.scale <= 0 or self.step_units <= 0:
            raise ValueError(f"expected a positive scale and step, got {self.scale} and {self.step_units}")
        _check_pose(self.T_world_from_object, self.scale)

    @property
    def parameter_count(self) -> int:
        """Number of rows of ``theta``."""
        return prod(self.theta_shape[:-1])

    @property
    def free_count(self) -> int:
        """Number of free rows of the colour vector: the rows of ``theta``, unless these are mixed."""
        return self.parameter_count if self.mixing is None else int(self.mixing.shape[0])

    @property
    def slot_count(self) -> int:
        """Number of rows of the colour vector, free and fixed."""
        return self.free_count + len(self.fixed_colours)

    @property
    def face_size_m(self) -> tuple[float, float] | None:
        """Width and height of its flat texture in the world, without a border [m]; None for a solid object."""
        if len(self.theta_shape) != 3:
            return None
        textured = self.slots[-1] < self.free_count
        shares = np.array([textured.any(axis=1).mean(), textured.any(axis=0).mean()])
        width_m, height_m = shares * self.scale * (np.asarray(self.box_max) - self.box_min)[1:]
        return float(width_m), float(height_m)

    @property
    def plain_theta(self) -> Array:
        """Free parameters without an attack, ``[parameter_count, 3]``; grey by default."""
        if self.plain_colours is not None:
            values = inverse_squash(self.plain_colours)
        else:
            plain = self.fixed_colours.mean(axis=0) if len(self.fixed_colours) else np.full(3, 0.5)
            values = np.broadcast_to(inverse_squash(plain), (self.free_count, 3))
        if self.mixing is None:
            return values
        return np.stack(
            [lsqr(self.mixing, values[:, k], atol=1e-6, btol=1e-6, iter_lim=200)[0] for k in range(3)],
            axis=-1,
        )

    @property
    def sha256(self) -> str:
        """Hash of the object except its free colours."""
        digest = hashlib.sha256(
            repr((self.theta_shape, self.scale, self.one_sided, self.step_units)).encode()
        )
        parts = [
            self.slots,
            self.fixed_colours,
            self.box_min,
            self.box_max,
            self.T_world_from_object,
            self.density,
        ]
        if self.mixing is not None:
            parts += [self.mixing.data, self.mixing.indices, self.mixing.indptr]
        for part in parts:
            array: NDArray[np.generic] = np.zeros(0) if part is None else np.ascontiguousarray(part)
            digest.update(f"{array.dtype} {array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def check_theta(self, theta: Tensor) -> None:
        """Raise ``ValueError`` unless ``theta`` has the object's ``theta_shape``."""
        if tuple(theta.shape) != tuple(self.theta_shape):
            raise ValueError(f"expected theta of shape {tuple(self.theta_shape)}, got {tuple(theta.shape)}")

    def colours(self, theta: Tensor) -> Tensor:
        """The colour vector ``[slot_count, 3]``: squashed free rows, then the fixed ones; with autograd history."""
        self.check_theta(theta)
        fixed = torch.as_tensor(self.fixed_colours, dtype=theta.dtype, device=theta.device).reshape(-1, 3)
        rows = theta.reshape(-1, 3)
        if self.mixing is not None:
            entries = self.mixing.tocoo()
            places = torch.from_numpy(np.stack([entries.row, entries.col]).astype(np.int64))
            data = torch.from_numpy(entries.data).to(theta.dtype)
            matrix = torch.sparse_coo_tensor(places, data, entries.shape, check_invariants=True)
            rows = matrix.to(theta.device) @ rows
        return torch.cat([squash(rows), fixed])

    def neighbours(self) -> NDArray[np.int64]:
        """Pairs ``[P, 2]`` of different free rows that are shown by voxels next to each other, each pair once."""
        pairs = []
        for axis in range(3):
            first = np.moveaxis(self.slots, axis, 0)[:-1].reshape(-1)
            second = np.moveaxis(self.slots, axis, 0)[1:].reshape(-1)
            pairs.append(np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1))
        together = np.concatenate(pairs).astype(np.int64)
        together = together[(together[:, 1] < self.free_count) & (together[:, 0] != together[:, 1])]
        return np.unique(together, axis=0)

    def moved(self, T_world_from_object: ArrayLike, scale: float | None = None) -> VoxelGridObject:
        """The same object at another pose ``[4, 4]``, and with another scale if one is given; data that renderers derived from it is shared."""
        pose = np.asarray(T_world_from_object, dtype=np.float64)
        other = replace(self, T_world_from_object=pose, scale=self.scale if scale is None else scale)
        object.__setattr__(other, "derived", self.derived)
        return other


def _check_pose(T_world_from_object: Array, scale: float) -> None:
    """Raise ``ValueError`` unless the pose is rigid and finite: only the scale may change lengths."""
    T = np.asarray(T_world_from_object)
    if T.shape != (4, 4) or not (np.isfinite(T).all() and np.isfinite(scale)):
        raise ValueError(
            f"expected a finite pose [4, 4] and scale of an object, got {T.tolist()} and {scale}"
        )
    R = T[:3, :3]
    if (
        not np.allclose(R @ R.T, np.eye(3), atol=1e-4)
        or np.linalg.det(R) < 0
        or not np.allclose(T[3], [0, 0, 0, 1])
    ):
        raise ValueError(
            f"expected a rigid pose of an object (its size goes into the scale), got {T.tolist()}"
        )


def squash(theta: Tensor) -> Tensor:
    """Colours in 0..1 of grid values: the logistic function."""
    return torch.sigmoid(theta)


def squash_derivative(theta: Tensor) -> Tensor:
    """Derivative of :func:`squash` at ``theta``, elementwise."""
    colour = torch.sigmoid(theta)
    return colour * (1.0 - colour)


def inverse_squash(colour: ArrayLike) -> Array:
    """Grid values whose squash is ``colour``; colours are kept half an 8-bit step away from 0 and 1."""
    c = np.clip(np.asarray(colour, dtype=np.float64), _SATURATION, 1.0 - _SATURATION)
    return np.log(c) - np.log1p(-c)


def cube_face_object(
    size_m: float = 0.80,
    resolution: int = 16,
    plain_rgb: ArrayLike = (0.15, 0.55, 0.25),
    T_world_from_object: ArrayLike | None = None,
    depth_m: float = 0.01,
    one_sided: bool = True,
) -> VoxelGridObject:
    """An opaque slab or cube with one textured square face; the rest is plain.

    The texture reaches two voxels deep (the whole depth of a thin slab), so where a ray enters through the face the colour is
    exactly the bilinear interpolation of the squashed ``[resolution, resolution, 3]`` grid at its cell centres.

    Args:
        size_m: Edge of the face [m].
        resolution: Texture cells along an edge; low values transfer, high frequencies do not.
        plain_rgb: Colour of everything that is not the face, in 0..1.
        T_world_from_object: Pose ``[4, 4]``; origin at the face's centre, x = outward normal. Default: identity.
        depth_m: Thickness behind the face [m]; ``size_m`` makes a cube.
        one_sided: See :class:`VoxelGridObject`.
    """
    if size_m <= 0 or depth_m <= 0 or resolution < 1:
        raise ValueError(
            f"expected positive sizes, got size {size_m} m, depth {depth_m} m, {resolution} cells"
        )
    layers = max(3, round(resolution * depth_m / size_m))
    free = resolution * resolution
    slots = np.full((layers, resolution, resolution), free, dtype=np.int32)
    column, z_index = np.meshgrid(np.arange(resolution), np.arange(resolution), indexing="ij")
    texture = ((resolution - 1 - z_index) * resolution + column).astype(np.int32)
    textured = layers if depth_m < 2.0 * size_m / resolution else 2
    slots[layers - textured :] = texture
    half = 0.5 * size_m
    pose = np.eye(4) if T_world_from_object is None else np.asarray(T_world_from_object, dtype=np.float64)
    return VoxelGridObject(
        slots=slots,
        theta_shape=(resolution, resolution, 3),
        fixed_colours=np.asarray(plain_rgb, dtype=np.float64).reshape(1, 3),
        box_min=np.array([-depth_m, -half, -half]),
        box_max=np.array([0.0, half, half]),
        T_world_from_object=pose,
        one_sided=one_sided,
    )


def with_border(panel: VoxelGridObject, colours: ArrayLike) -> VoxelGridObject:
    """A panel of `cube_face_object` with a border of fixed colours around its face.

    Args:
        colours: Colours of border and face ``[n, n, 3]`` in 0..1, row 0 on top, column 0 left for a viewer, in voxels as large as the face's;
            the face's part is not used.
    """
    drawn = np.asarray(colours, dtype=np.float64)
    across, rest = divmod(len(drawn) - len(panel.slots[0]), 2)
    if drawn.shape != (len(drawn), len(drawn), 3) or across < 1 or rest:
        raise ValueError(
            f"expected colours [n, n, 3] with a border on every side of {len(panel.slots[0])}, got {drawn.shape}"
        )
    around = np.ones(drawn.shape[:2], dtype=bool)
    around[across:-across, across:-across] = False
    slots = np.pad(
        panel.slots, ((0, 0), (across, across), (across, across)), constant_values=panel.free_count
    )
    rows = np.full(around.shape, -1)
    rows[around] = panel.slot_count + np.arange(around.sum())
    voxels = rows.T[:, ::-1]  # of a picture's rows and columns those along y and z
    slots[:, voxels >= 0] = voxels[voxels >= 0]
    wider = across * (panel.box_max[1] - panel.box_min[1]) / len(panel.slots[0])
    grown = np.array([0.0, wider, wider])
    return replace(
        panel,
        slots=slots,
        fixed_colours=np.concatenate([panel.fixed_colours, drawn[around]]),
        plain_colours=np.broadcast_to(panel.fixed_colours[0], (panel.free_count, 3)),
        box_min=panel.box_min - grown,
        box_max=panel.box_max + grown,
    )


def face_corners_in_object(size_m: float) -> Array:
    """Corners ``[4, 3]`` of the deployed face: top left, top right, bottom right, bottom left for its viewer [m]."""
    h = 0.5 * size_m
    return np.array([[0.0, -h, h], [0.0, h, h], [0.0, h, -h], [0.0, -h, -h]])
