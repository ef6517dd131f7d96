"""Projection of Gaussians into a pinhole image: the constants of 3D Gaussian splatting, and a view in the form that kernels read.

As in the code of Kerbl et al. 2023: the covariance goes through the Jacobian of the projection at the centre (Zwicker et al. 2001, "EWA
splatting"), at most 1.3 times as far from the middle as the image reaches, plus 0.3 px^2. Gaussians are drawn in the order of their
centres' depths, where their opacity is at least 1/255. Two details differ, each by less than a hundredth of a colour: that contour is not
cut by tiles, and the Gaussian after which less than 1e-4 of the light comes through is still drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.geometry import Array, Pinhole

DILATION_PX2 = 0.3
MOST_ALPHA = 0.99
LEAST_ALPHA = 1.0 / 255.0
LEAST_TRANSMITTANCE = 1e-4
_BEYOND = 0.3  # of half the image's field of view, for the Jacobian


@dataclass(frozen=True, eq=False)
class View:
    """A camera in the form that kernels read.

    Attributes:
        T_camera_from_world: ``[3, 4]`` float32.
        centre_m: Place of the camera ``[3]`` [m].
        limits: Smallest and largest ``x / z``, smallest and largest ``y / z`` for the Jacobian ``[4]`` float32.
        near_m: Gaussians whose centres are nearer are left out [m].
    """

    T_camera_from_world: NDArray[np.float32]
    centre_m: Array
    limits: Tensor
    near_m: np.float32

    @classmethod
    def of(cls, T_world_from_camera: ArrayLike, pinhole: Pinhole, near_m: float) -> View:
        """The view of a pose ``[4, 4]``."""
        pose = np.asarray(T_world_from_camera, np.float64)
        inverse = np.ascontiguousarray(np.linalg.inv(pose)[:3], np.float32)
        limits = []
        for size, focal, centre in (
            (pinhole.width, pinhole.fx, pinhole.cx),
            (pinhole.height, pinhole.fy, pinhole.cy),
        ):
            beyond = _BEYOND * 0.5 * size / focal
            limits += [-centre / focal - beyond, (size - centre) / focal + beyond]
        return cls(inverse, pose[:3, 3].copy(), torch.tensor(limits, dtype=torch.float32), np.float32(near_m))


def drawn_within(opacities: NDArray[np.float32]) -> NDArray[np.float32]:
    """Largest squared Mahalanobis distance at which each of ``opacities [N]`` is drawn; negative if nowhere."""
    with np.errstate(divide="ignore"):
        found = 2.0 * np.log(np.asarray(opacities, np.float64) / LEAST_ALPHA)
    return np.asarray(np.maximum(found, -1.0), np.float32)
