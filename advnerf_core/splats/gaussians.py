"""Gaussians of a splat scene, as Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", define them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from advnerf_core.data.similarity import Similarity
from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.spherical_harmonics import MAX_BANDS, spherical_harmonics
from advnerf_core.geometry import Array

Array32 = NDArray[np.float32]

CONSTANT_BASIS = 0.28209479177387814  # the spherical harmonic of degree 0
COLOUR_OFFSET = 0.5
FOR_A_MESH = "of a mesh, 'advnerf scene object build' makes an object"


class SplatError(AdvnerfError):
    """A splat cannot be read or used; the message says what is wrong with it."""


@dataclass(frozen=True, eq=False)
class GaussianSplats:
    """Gaussians with opacity and a colour that depends on the direction. Positions are in metres once the splat is in the world.

    Attributes:
        means_m: Centres ``[N, 3]`` float32 [m].
        scales_m: Standard deviations along the principal axes ``[N, 3]`` float32 [m].
        rotations: Unit quaternions ``w, x, y, z`` from the principal axes to the world ``[N, 4]`` float32.
        opacities: Largest opacity of each, 0..1, ``[N]`` float32.
        harmonics: Coefficients of real spherical harmonics ``[N, K, 3]`` float32, ``K`` = 1, 4, 9 or 16. The colour along a unit direction
            is ``0.5 + sum_k harmonics[k] Y_k(direction)``, not below 0.
    """

    means_m: Array32
    scales_m: Array32
    rotations: Array32
    opacities: Array32
    harmonics: Array32

    def __post_init__(self) -> None:
        count = len(self.means_m)
        expected = {
            "means_m": (count, 3),
            "scales_m": (count, 3),
            "rotations": (count, 4),
            "opacities": (count,),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {getattr(self, name).shape}")
        bands = {bands**2 for bands in range(1, MAX_BANDS + 1)}
        if (
            self.harmonics.ndim != 3
            or self.harmonics.shape[1] not in bands
            or self.harmonics.shape[::2] != (count, 3)
        ):
            raise ValueError(f"expected harmonics [{count}, 1 | 4 | 9 | 16, 3], got {self.harmonics.shape}")

    def __len__(self) -> int:
        return len(self.means_m)

    @property
    def bands(self) -> int:
        """Bands of spherical harmonics, 1..4: one more than the degree."""
        return round(self.harmonics.shape[1] ** 0.5)

    def chosen(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> GaussianSplats:
        """Only some of the Gaussians."""
        return GaussianSplats(*(np.ascontiguousarray(part[which]) for part in vars(self).values()))

    def ordered(self) -> GaussianSplats:
        """The same Gaussians along a curve through space (Morton 1966), so that neighbours lie beside each other in memory."""
        low, high = self.means_m.min(axis=0), self.means_m.max(axis=0)
        cells = ((self.means_m - low) * (1023.0 / max(float((high - low).max()), 1e-12))).astype(np.int64)
        code = np.zeros(len(self), np.int64)
        for bit in range(10):
            for axis in range(3):
                code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
        return self.chosen(np.argsort(code, kind="stable"))

    def covariances(self) -> Array32:
        """Covariances ``[N, 6]``: xx, xy, xz, yy, yz, zz [m^2]."""
        w, x, y, z = self.rotations.astype(np.float64).T
        axes = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        axes = axes * self.scales_m.T.astype(np.float64)
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        return np.stack([(axes[i] * axes[j]).sum(axis=0) for i, j in pairs], axis=1).astype(np.float32)

    def moved(self, similarity: Similarity) -> GaussianSplats:
        """The same scene in another world: centres, sizes, axes and the directions of colours."""
        turn = similarity.T_target_from_source[:3, :3]
        x, y, z, w = (Rotation.from_matrix(turn) * _rotations(self.rotations)).as_quat().T
        return replace(
            self,
            means_m=similarity.points(self.means_m).astype(np.float32),
            scales_m=(similarity.scale * self.scales_m.astype(np.float64)).astype(np.float32),
            rotations=np.stack([w, x, y, z], axis=1).astype(np.float32),
            harmonics=_turned(self.harmonics, turn),
        )


def _rotations(quaternions: Array32) -> Rotation:
    w, x, y, z = quaternions.astype(np.float64).T
    return Rotation.from_quat(np.stack([x, y, z, w], axis=1))


def _turned(harmonics: Array32, turn: Array) -> Array32:
    """Coefficients in a world whose directions are ``turn`` times the old ones: each band is closed under rotations."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = harmonics.astype(np.float64)
    for band in range(1, round(harmonics.shape[1] ** 0.5)):
        part = slice(band**2, (band + 1) ** 2)
        new, old = (
            spherical_harmonics(torch.from_numpy(d), band + 1).numpy()[:, part]
            for d in (directions, directions @ turn)
        )
        turned[:, part] = np.einsum("kj,njc->nkc", np.linalg.pinv(new) @ old, turned[:, part])
    return turned.astype(np.float32)
