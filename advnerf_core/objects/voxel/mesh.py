"""Textured triangle meshes as plain arrays: what a GLB file, or a generator, says about the surface of an object.

Loading is trimesh's; what is kept is what voxelising and drawing need: triangles, a UV coordinate for each of their corners, and
one texture for each part. Vertex colours and plain materials become textures of a part as well (one texel per colour), so that
there is one way to ask for the colour of a surface point.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array

_GREY = (0.6, 0.6, 0.6)
# glTF says y up; what robots drive among has z up.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_SANE_SIZE = (1e-6, 1e6)


class MeshError(AdvnerfError, ValueError):
    """A mesh cannot be read or has no surface that an object could be made of."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles that share one texture.

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
    """The surface of an object, z up, its base in the plane z = 0, its axis at the origin; ``parts`` in metres."""

    parts: tuple[MeshPart, ...]

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

    @property
    def triangle_count(self) -> int:
        """Number of triangles of all parts."""
        return sum(len(part.triangles) for part in self.parts)


def load_mesh(path: Path, up: str = "z", height_m: float | None = None) -> SurfaceMesh:
    """Read a mesh file (GLB, OBJ, PLY, STL, ... whatever trimesh reads).

    Args:
        path: The file; textures and the scene graph's transforms are taken over.
        up: Which axis of the file points up, ``"z"`` or ``"y"`` (glTF's own convention).
        height_m: Scale to this height [m]; None believes the file.

    Raises:
        MeshError: No file, not a mesh, no triangles, coordinates that are not finite, or a size no scene has.
    """
    if up not in ("y", "z"):
        raise MeshError(f"expected up to be 'y' or 'z', got {up!r}")
    _check_height(height_m)
    parts = [_part(geometry, path) for geometry in _geometries(path)]
    if not parts or sum(len(part.triangles) for part in parts) == 0:
        raise MeshError(
            f"expected a mesh with triangles in {path}, got none: is it a point cloud or an empty scene?"
        )
    return stand(SurfaceMesh(tuple(parts)), up, height_m, str(path))


def stand(
    mesh: SurfaceMesh, up: str = "z", height_m: float | None = None, name: str = "the mesh"
) -> SurfaceMesh:
    """Turn a mesh upright, put its base on z = 0 and the middle of its box over the origin, and scale it."""
    _check_height(height_m)
    turn = _Z_UP_FROM_Y_UP if up == "y" else np.eye(3)
    turned = [MeshPart(part.triangles @ turn.T, part.uv, part.texture) for part in mesh.parts]
    low, high = SurfaceMesh(tuple(turned)).box
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise MeshError(f"expected finite coordinates in {name}, got some that are not")
    size = high - low
    if not _SANE_SIZE[0] < size.max() < _SANE_SIZE[1]:
        raise MeshError(f"expected {name} to have a size, got a box of {size.tolist()}")
    if height_m is not None and size[2] <= 0:
        raise MeshError(f"expected {name} to have a height to scale, it is flat; try --up y")
    scale = 1.0 if height_m is None else height_m / size[2]
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return SurfaceMesh(tuple(MeshPart((p.triangles - base) * scale, p.uv, p.texture) for p in turned))


def _check_height(height_m: float | None) -> None:
    if height_m is not None and not (np.isfinite(height_m) and height_m > 0):
        raise MeshError(f"expected a height above zero, got {height_m}")


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


def _geometries(path: Path) -> list[Any]:
    import trimesh

    if not path.is_file():
        raise MeshError(f"expected a mesh file at {path}, found none")
    try:
        scene = trimesh.load_scene(path)
        dumped = scene.dump(concatenate=False)
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise MeshError(
            f"cannot read {path} as a mesh ({type(error).__name__}: {error}); export it again"
        ) from error
    return [geometry for geometry in dumped if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)]


def _part(geometry: Any, path: Path) -> MeshPart:
    faces = np.asarray(geometry.faces)
    triangles = np.asarray(geometry.vertices, dtype=np.float64)[faces]
    visual = geometry.visual
    uv = getattr(visual, "uv", None)
    if uv is not None and len(uv) == len(geometry.vertices):
        return MeshPart(
            triangles, np.nan_to_num(np.asarray(uv, dtype=np.float64))[faces], _texture(visual.material, path)
        )
    colours = getattr(visual, "face_colors", None)
    if visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[faces].mean(axis=1)
    if visual.defined and colours is not None and len(colours) == len(faces):
        return part_from_colours(triangles, np.asarray(colours)[:, :3] / 255.0)
    main = getattr(getattr(visual, "material", None), "main_color", None)
    rgb = np.array(_GREY) if main is None else np.asarray(main)[:3] / 255.0
    return part_from_colours(triangles, np.broadcast_to(rgb, (len(faces), 3)))


def _texture(material: Any, path: Path) -> NDArray[np.float32]:
    image = getattr(material, "baseColorTexture", None)
    if image is None:
        image = getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    rgb = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
    if image is None:
        if factor is None:
            rgb = (
                np.asarray(getattr(material, "main_color", [255 * c for c in _GREY]), dtype=np.float64)[:3]
                / 255.0
            )
        return rgb.astype(np.float32).reshape(1, 1, 3)
    try:
        pixels = np.asarray(image.convert("RGB"), dtype=np.float32) / 255.0
    except OSError as error:
        raise MeshError(f"cannot read a texture of {path} ({error}); export it again") from error
    return np.ascontiguousarray(pixels * rgb.astype(np.float32))
