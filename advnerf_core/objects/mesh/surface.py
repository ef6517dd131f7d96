"""Attackable meshes: welded vertices, and one texture whose texels are the free colours.

An attacked texture needs texels of one size on the whole surface, coarse ones (high frequencies do not transfer), and no
repeats. So the mesh gets new texture coordinates: each triangle is seen along the axis that it faces most, and the six views
(from front, back, left, right, above and below) lie side by side in the texture. Layers that face the same way behind one another
share their texels. Inside a chart colours are continuous; no sample of a chart reads another chart's texels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from advnerf_core.geometry import Array
from advnerf_core.objects.voxel.mesh import MeshError, SurfaceMesh, part_from_colours, texture_colours

_WELD = 1e-6  # relative to the size: nearer vertices are merged
_SAMPLES_PER_TEXEL = 16.0
_SMOOTH_COS = 0.75  # between a triangle and its surroundings; where they turn more, there is an edge
_OUTER = 0.1  # texels: anything deeper below the outermost layer does not contribute its colour
# In-plane axes of the six views (column, row) with their signs, so that each is upright for a viewer outside.
_VIEWS = (
    ((1, 1), (2, -1)), ((1, -1), (2, -1)),  # from +x and -x
    ((0, -1), (2, -1)), ((0, 1), (2, -1)),  # from +y and -y
    ((0, 1), (1, -1)), ((0, -1), (1, -1)),  # from above and below
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A surface with one texture.

    Attributes:
        vertices: ``[V, 3]`` in the object's frame [m].
        faces: Indices of the corners ``[F, 3]`` int32.
        texels: Positions of the corners in the texture, column and row ``[F, 3, 2]``; texel centres are at +0.5.
        texture: Colours without an attack, ``[H, W, 3]`` float32 in 0..1, row 0 on top.
        charts: Chart of each texel ``[H, W]`` int16; -1 for none.
    """

    vertices: Array
    faces: NDArray[np.int32]
    texels: Array
    texture: NDArray[np.float32]
    charts: NDArray[np.int16]

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.isfinite(self.vertices).all():
            raise MeshError(f"expected finite vertices [V, 3], got shape {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3 or not len(self.faces):
            raise MeshError(f"expected faces [F, 3], got shape {self.faces.shape}")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise MeshError(f"expected faces of {len(self.vertices)} vertices, got index {self.faces.max()}")
        if self.texels.shape != (len(self.faces), 3, 2) or self.charts.shape != self.texture.shape[:2]:
            raise MeshError(f"expected texels {(len(self.faces), 3, 2)}, got {self.texels.shape}")

    @property
    def corners(self) -> Array:
        """Corners of the triangles ``[F, 3, 3]``."""
        return np.asarray(self.vertices[self.faces])

    @property
    def box(self) -> tuple[Array, Array]:
        """Smallest and largest coordinates."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def with_vertices(self, vertices: Array) -> TexturedMesh:
        """The same surface in another shape."""
        return replace(self, vertices=np.asarray(vertices, dtype=np.float64))

    def with_texture(self, texture: NDArray[np.float32]) -> TexturedMesh:
        """The same surface in other colours ``[H, W, 3]``."""
        if texture.shape != self.texture.shape:
            raise MeshError(f"expected a texture {self.texture.shape}, got {texture.shape}")
        return replace(self, texture=np.asarray(texture, dtype=np.float32))


def unwrapped(mesh: SurfaceMesh, resolution: int = 32) -> TexturedMesh:
    """Weld a mesh and give it one texture, in its own colours; see `with_places`."""
    return with_places(mesh, resolution)[0]


def with_places(mesh: SurfaceMesh, resolution: int) -> tuple[TexturedMesh, Array]:
    """Weld a mesh and give it one texture, in its own colours.

    Args:
        mesh: The surface [m].
        resolution: Texels along its longest side.

    Returns:
        The mesh, and the place of each texel on its surface ``[H, W, 3]`` [m]; that of texels outside all charts is the origin.

    Raises:
        MeshError: All triangles are without area, or the resolution is not in 2..512.
    """
    if not 2 <= resolution <= 512:
        raise MeshError(f"expected 2 to 512 texels along the longest side, got {resolution}")
    triangles = np.concatenate([part.triangles for part in mesh.parts])
    size = float(mesh.size_m.max())
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    solid = np.linalg.norm(normals, axis=1) > (1e-7 * size) ** 2
    vertices, faces = _welded(triangles, _WELD * size)
    solid &= (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    if not solid.any():
        raise MeshError("expected a mesh with triangles that have an area, got none")
    view = _facing(normals)[solid]
    corners = vertices[faces[solid]]
    texels, charts = _layout(corners, view, size / (resolution - 1))
    baked = _baked(mesh, solid, corners, texels, view, charts, size / (resolution - 1))
    used = np.unique(faces[solid])
    place = np.zeros(len(vertices), np.int32)
    place[used] = np.arange(len(used), dtype=np.int32)
    texture = baked[..., :3].astype(np.float32)
    return TexturedMesh(vertices[used], place[faces[solid]], texels, texture, charts), baked[..., 3:]


def corner_normals(mesh: TexturedMesh) -> Array:
    """Unit normals at the corners of the triangles ``[F, 3, 3]``: smooth over the surface, but not over its edges."""
    sides = np.diff(mesh.corners, axis=1)
    areas = np.cross(sides[:, 0], sides[:, 1])
    flat = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    sums = np.zeros_like(mesh.vertices)
    np.add.at(sums, mesh.faces.reshape(-1), np.repeat(areas, 3, axis=0))
    smooth = (sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300))[mesh.faces]
    sharp = np.einsum("fkc,fc->fk", smooth, flat) < _SMOOTH_COS
    return np.where(sharp[..., None], flat[:, None], smooth)


def sphere(radius_m: float, rgb: tuple[float, float, float], subdivisions: int = 3) -> SurfaceMesh:
    """A ball of one colour that stands on z = 0: a subdivided icosahedron, as the start of a shape attack."""
    import trimesh

    if not (np.isfinite(radius_m) and radius_m > 0 and 0 <= subdivisions <= 6):
        raise MeshError(
            f"expected a radius above zero and 0 to 6 subdivisions, got {radius_m} and {subdivisions}"
        )
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m)
    triangles = np.asarray(ball.triangles, dtype=np.float64) + np.array([0.0, 0.0, radius_m])
    return SurfaceMesh(
        (part_from_colours(triangles, np.tile(np.asarray(rgb, np.float64), (len(triangles), 1))),)
    )


def _welded(triangles: Array, tolerance: float) -> tuple[Array, NDArray[np.int32]]:
    points = triangles.reshape(-1, 3)
    _, first, place = np.unique(np.round(points / tolerance), axis=0, return_index=True, return_inverse=True)
    return points[first], place.reshape(-1, 3).astype(np.int32)


def _facing(normals: Array) -> NDArray[np.int64]:
    """Index of the view that sees a triangle best, ``[F]``."""
    axis = np.abs(normals).argmax(axis=1)
    away = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] < 0
    return np.asarray(2 * axis + away)


def _layout(corners: Array, view: NDArray[np.int64], texel: float) -> tuple[Array, NDArray[np.int16]]:
    """Coordinates ``[F, 3, 2]`` of the corners in the texture, and the view of each texel."""
    texels = np.zeros((len(corners), 3, 2))
    rectangles, width = [], 0
    for number, ((across, flip), (down, turn)) in enumerate(_VIEWS):
        mine = view == number
        if not mine.any():
            continue
        plane = np.stack([flip * corners[mine][..., across], turn * corners[mine][..., down]], axis=-1)
        plane = (plane - plane.reshape(-1, 2).min(axis=0)) / texel
        columns, rows = np.ceil(plane.reshape(-1, 2).max(axis=0) - 1e-9).astype(int) + 1
        texels[mine] = plane + np.array([width + 0.5, 0.5])
        rectangles.append((number, width, int(columns), int(rows)))
        width += int(columns)
    charts = np.full((max(rows for *_, rows in rectangles), width), -1, dtype=np.int16)
    for number, first, columns, rows in rectangles:
        charts[:rows, first : first + columns] = number
    return texels, charts


def _baked(
    mesh: SurfaceMesh,
    solid: NDArray[np.bool_],
    corners: Array,
    texels: Array,
    view: NDArray[np.int64],
    charts: NDArray[np.int16],
    texel: float,
) -> Array:
    """Mean colour and place of the outermost layer in each texel ``[H, W, 6]``; texels that no triangle touches take the nearest one's."""
    face, weights = _spread(corners, texel)
    colours = _colours(mesh, np.flatnonzero(solid)[face], weights)
    where = np.floor(np.einsum("nk,nkc->nc", weights, texels[face])).astype(np.int64)
    where = np.clip(where, 0, np.array(charts.shape[::-1]) - 1)
    flat = where[:, 1] * charts.shape[1] + where[:, 0]
    points, axis = np.einsum("nk,nkc->nc", weights, corners[face]), view[face] // 2
    height = np.take_along_axis(points, axis[:, None], axis=1)[:, 0] * np.where(
        view[face] % 2 == 0, 1.0, -1.0
    )
    top = np.full(charts.size, -np.inf)
    np.maximum.at(top, flat, height)
    outer = height >= top[flat] - _OUTER * texel
    count = np.bincount(flat[outer], minlength=charts.size)
    values = np.concatenate([colours[outer], points[outer]], axis=1)
    sums = [np.bincount(flat[outer], values[:, k], minlength=charts.size) for k in range(6)]
    means = (np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]).reshape(*charts.shape, 6)
    return _filled(means, count.reshape(charts.shape) > 0, charts)


def _spread(corners: Array, texel: float) -> tuple[NDArray[np.int64], Array]:
    """Points spread evenly over the triangles: their faces ``[N]`` and barycentric weights ``[N, 3]``."""
    edges = corners[:, 1:] - corners[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    counts = np.clip(np.ceil(_SAMPLES_PER_TEXEL * areas / texel**2), 8, 4096).astype(np.int64)
    face = np.repeat(np.arange(len(corners)), counts)
    number = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    # Roberts' additive sequence in the plane; the half of the square beyond its diagonal is folded back.
    a, b = (0.5 + 0.7548776662466927 * number) % 1.0, (0.5 + 0.5698402909980532 * number) % 1.0
    beyond = a + b > 1.0
    a, b = np.where(beyond, 1.0 - a, a), np.where(beyond, 1.0 - b, b)
    return face, np.stack([1.0 - a - b, a, b], axis=-1)


def _colours(mesh: SurfaceMesh, face: NDArray[np.int64], weights: Array) -> Array:
    """Colours ``[N, 3]`` of points on faces of all parts."""
    out = np.empty((len(face), 3))
    first = 0
    for part in mesh.parts:
        mine = (face >= first) & (face < first + len(part.triangles))
        uv = np.einsum("nk,nkc->nc", weights[mine], part.uv[face[mine] - first])
        out[mine] = texture_colours(part.texture, uv)
        first += len(part.triangles)
    return out


def _filled(texture: Array, known: NDArray[np.bool_], charts: NDArray[np.int16]) -> Array:
    for number in np.unique(charts[charts >= 0]):
        rows, columns = np.nonzero(charts == number)
        window = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        nearest = ndimage.distance_transform_edt(~known[window], return_distances=False, return_indices=True)
        texture[window] = texture[window][tuple(nearest)]
    return texture
