"""Intersections of rays and a mesh: Mitsuba's tracer, with plain arrays on both sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.engine import engine
from advnerf_core.objects.mesh.surface import TexturedMesh

_NEAR = 1e-3
_ALIGNMENT = 16  # floats


@dataclass(frozen=True, eq=False)
class Hits:
    """Intersections of rays with the surface.

    Attributes:
        rays: Indices of the rays that hit it ``[N]``, ascending.
        t: Distance in lengths of the ray's direction ``[N]``.
        faces: Indices of the triangles ``[N]``.
        weights: Barycentric weights of their corners ``[N, 3]``.
    """

    rays: NDArray[np.int64]
    t: Array
    faces: NDArray[np.int64]
    weights: Array


class RayCaster:
    """A mesh for ray casting; both sides of a triangle are hit."""

    def __init__(self, mesh: TexturedMesh) -> None:
        mi = engine().mi
        self._scene = mi.load_dict({"type": "scene", "mesh": mitsuba_mesh(mi, mesh.vertices, mesh.faces)})

    def cast(self, origins: Array, directions: Array) -> Hits:
        """Cast rays ``[N, 3]``; directions may have any length, and hits nearer than a thousandth of it are ignored."""
        used = engine()
        mi, dr = used.mi, used.dr
        if not len(origins):
            return Hits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3)))
        # Axis by axis: splitting a matrix would compile a kernel for each number of rays.
        o, d = ([floats(mi, axis) for axis in part.T] for part in (origins, directions))
        ray = mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d))
        ray.o += _NEAR * ray.d
        found = self._scene.ray_intersect_preliminary(ray, coherent=True)
        dr.eval(found.t, found.prim_index, found.prim_uv)
        t = np.array(found.t)
        rays = np.flatnonzero(np.isfinite(t))
        b = (
            np.stack([np.array(part)[rays] for part in found.prim_uv], axis=-1)
            .astype(np.float64)
            .clip(0.0, 1.0)
        )
        b /= np.maximum(b.sum(axis=1, keepdims=True), 1.0)
        weights = np.stack([1.0 - b.sum(axis=1), b[:, 0], b[:, 1]], axis=-1)
        return Hits(
            rays,
            t[rays].astype(np.float64) + _NEAR,
            np.array(found.prim_index)[rays].astype(np.int64),
            weights,
        )


def floats(mi: Any, values: ArrayLike) -> Any:
    """Numbers as a flat array of Mitsuba.

    Mitsuba reads an array of numpy in place, by a kernel that depends on its alignment; numpy's varies, and each frame might
    compile a new kernel. So it is copied to memory with a fixed alignment.
    """
    flat = np.asarray(values, dtype=np.float32).ravel()
    room = np.empty(len(flat) + _ALIGNMENT, np.float32)
    first = (-room.ctypes.data // room.itemsize) % _ALIGNMENT
    room[first : first + len(flat)] = flat
    return mi.Float(room[first : first + len(flat)])


def mitsuba_mesh(mi: Any, vertices: Array, faces: NDArray[np.int32]) -> object:
    """A mesh of Mitsuba without normals and texture coordinates; ``vertex_positions`` is its parameter."""
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = floats(mi, vertices)
    parameters["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    parameters.update()
    return mesh
