"""The interface of an object with free colours for renderers and attacks, independent of its geometry.

``VoxelGridObject`` implements it, and so does a textured mesh (``advnerf_core.objects.mesh.field``).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from advnerf_core.geometry import Array


class ColouredObject(Protocol):
    """An object whose pixels are linear in a vector of colours: the squashed free ones, then the fixed ones."""

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape ``[..., 3]`` of the free parameters."""

    @property
    def parameter_count(self) -> int:
        """Number of rows of ``theta``."""

    @property
    def free_count(self) -> int:
        """Number of free rows of the colour vector."""

    @property
    def slot_count(self) -> int:
        """Number of rows of the colour vector, free and fixed."""

    @property
    def fixed_colours(self) -> Array:
        """Colours of the rows after the free ones ``[F, 3]``."""

    @property
    def mixing(self) -> sparse.csr_matrix | None:
        """Free rows as sums of parameters before the squash; None is the identity."""

    @property
    def plain_theta(self) -> Array:
        """Free parameters without an attack ``[parameter_count, 3]``."""

    @property
    def T_world_from_object(self) -> Array:
        """Rigid pose ``[4, 4]``."""

    @property
    def scale(self) -> float:
        """World metres per object unit."""

    def check_theta(self, theta: Tensor) -> None:
        """Raise ``ValueError`` unless ``theta`` has ``theta_shape``."""

    def neighbours(self) -> NDArray[np.int64]:
        """Pairs ``[P, 2]`` of different free rows of theta that lie next to each other, each pair once."""
