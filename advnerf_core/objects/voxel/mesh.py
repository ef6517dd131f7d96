"""Textured triangle meshes as plain arrays: the surface of an object from a GLB file or a generator.

It keeps the data that voxelising and drawing need: triangles, a UV coordinate for each of their corners, and one texture for each
part. Vertex colours and plain materials become textures of a part as well (one texel per colour), so that there is one way to look up
the colour of a surface point. `mesh_files` reads files.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array

# glTF has y up, z to the front and x to the left (glTF 2.0, section 3.4), as have exports with y up of most tools; a robot's world has z up, x to the
# front and y to the left (ROS REP 103).
Z_UP_FROM_Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
Z_UP_FROM_Y_UP.setflags(write=False)
_SANE_SIZE = (1e-6, 1e6)


class MeshError(AdvnerfError, ValueError):
    """A mesh cannot be read or has no surface to make an object of."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles with a common texture.

    Attributes:
        triangles: Corners ``[F, 3, 3]``, in the mesh's unit.
        uv: Texture coordinates of the corners, ``[F, 3, 2]``; origin bottom left, as in glTF viewers' convention of trimesh.
        texture: ``[h, w, 3]`` float32 in 0..1, row 0 on top.
    """

    triangles: Array
    uv: Array
    texture: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """The surface of an object, z up, its base in the plane z = 0, its axis at the origin.

    Attributes:
        parts: Parts with their textures [m].
        notes: Sentences about content of its file that is left out.
        sha256: Hash of its file and of all files that this names; empty for a generated mesh.
    """

    parts: tuple[MeshPart, ...]
    notes: tuple[str, ...] = ()
    sha256: str = ""

    @property
    def box(self) -> tuple[Array, Array]:
        """Smallest and largest coordinates."""
        corners = np.concatenate([part.triangles.reshape(-1, 3) for part in self.parts])
        return corners.min(axis=0), corners.max(axis=0)

    @property
    def size_m(self) -> Array:
        """Extent along x, y, z [m]."""
        low, high = self.box
        return np.asarray(high - low)

    def scaled(self, factor: float) -> SurfaceMesh:
        """The same mesh, larger by a factor."""
        if factor == 1.0:
            return self
        parts = (MeshPart(part.triangles * factor, part.uv, part.texture) for part in self.parts)
        return SurfaceMesh(tuple(parts), self.notes)

    @property
    def triangle_count(self) -> int:
        """Number of triangles of all parts."""
        return sum(len(part.triangles) for part in self.parts)


def stand(
    mesh: SurfaceMesh, up: str = "z", height_m: float | None = None, name: str = "the mesh"
) -> SurfaceMesh:
    """Turn a mesh upright, put its base on z = 0 and the middle of its box over the origin, and scale it."""
    if up not in ("y", "z"):
        raise MeshError(f"expected up to be 'y' or 'z', got {up!r}")
    if height_m is not None and not (np.isfinite(height_m) and height_m > 0):
        raise MeshError(f"expected a height above zero, got {height_m}")
    turn = Z_UP_FROM_Y_UP if up == "y" else np.eye(3)
    turned = [MeshPart(part.triangles @ turn.T, part.uv, part.texture) for part in mesh.parts]
    low, high = SurfaceMesh(tuple(turned)).box
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise MeshError(f"expected finite coordinates in {name}, got some that are not")
    size = high - low
    if not _SANE_SIZE[0] < size.max() < _SANE_SIZE[1]:
        raise MeshError(f"expected {name} to have a size, got a box of {size.tolist()}")
    if height_m is not None and size[2] <= 0:
        raise MeshError(
            f"expected {name} to have a height to scale, it is flat; give the axis that points up"
        )
    scale = 1.0 if height_m is None else height_m / size[2]
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return SurfaceMesh(tuple(MeshPart((p.triangles - base) * scale, p.uv, p.texture) for p in turned))


def part_from_colours(triangles: Array, rgb: Array) -> MeshPart:
    """A part whose triangles each have one colour ``[F, 3]`` in 0..1."""
    texture = np.asarray(rgb, dtype=np.float32).reshape(1, -1, 3)
    u = (np.arange(len(triangles)) + 0.5) / max(len(triangles), 1)
    uv = np.repeat(np.stack([u, np.full_like(u, 0.5)], axis=-1)[:, None], 3, axis=1)
    return MeshPart(np.asarray(triangles, dtype=np.float64), uv, texture)


def texture_colours(texture: NDArray[np.float32], uv: Array) -> Array:
    """Nearest texels at ``uv [N, 2]``, repeating beyond 0..1, ``[N, 3]``."""
    height, width = texture.shape[:2]
    wrapped = uv - np.floor(uv)
    column = np.minimum((wrapped[:, 0] * width).astype(np.int64), width - 1)
    row = np.minimum(((1.0 - wrapped[:, 1]) * height).astype(np.int64), height - 1)
    return np.asarray(texture[row, column], dtype=np.float64)
