"""The true surface of an object of voxels, in the voxels' colours: what a renderer shows that draws triangles and no voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.objects.mesh.surface import TexturedMesh, with_places
from advnerf_core.objects.voxel.mesh import SurfaceMesh

_MOST_TEXELS = 512


@dataclass(frozen=True, eq=False)
class Skin:
    """The surface of an object of voxels.

    Attributes:
        mesh: The surface, in the object's frame, with its own colours.
        rows: Row of the object's colour vector that each texel shows ``[H, W]``.
    """

    mesh: TexturedMesh
    rows: NDArray[np.int32]

    def texture(self, field: VoxelGridObject, theta: Tensor) -> NDArray[np.float32]:
        """The texture ``[H, W, 3]`` in the colours ``theta`` of its object, or of a moved copy."""
        colours = field.colours(theta.detach()).numpy()
        return np.asarray(colours[self.rows], dtype=np.float32)


def skin_of(field: VoxelGridObject, surface: SurfaceMesh) -> Skin:
    """The surface that an object of voxels was made of; each texel is a voxel wide and has the colour of the nearest voxel.

    Args:
        field: The object, solid.
        surface: The mesh in its frame, in its unit.
    """
    cells = np.array(field.slots.shape)
    voxel = (np.asarray(field.box_max) - field.box_min) / cells
    wanted = 1 + int(np.ceil(surface.size_m.max() / voxel.min()))
    mesh, places = with_places(surface, int(np.clip(wanted, 2, _MOST_TEXELS)))
    nearest = ndimage.distance_transform_edt(
        field.slots >= field.free_count, return_distances=False, return_indices=True
    )
    at = np.clip(np.floor((places - field.box_min) / voxel).astype(int), 0, cells - 1)
    i, j, k = nearest[:, at[..., 0], at[..., 1], at[..., 2]]
    return Skin(mesh, field.slots[i, j, k])
