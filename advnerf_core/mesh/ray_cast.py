"""Where rays meet a mesh: Mitsuba's tracer, with plain arrays on both sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from advnerf_core.mesh.engine import engine
from advnerf_core.mesh.surface import TexturedMesh

_NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays met the surface.

    Attributes:
        rays: Which rays hit it ``[N]``, ascending.
        t: Distance in lengths of the ray's direction ``[N]``.
        faces: Triangles ``[N]``.
        weights: Barycentric weights of their corners ``[N, 3]``.
    """

    rays: NDArray[np.int64]
    t: Array
    faces: NDArray[np.int64]
    weights: Array


class RayCaster:
    """A mesh that rays can be cast at; both sides of a triangle are hit.

    Args:
        mesh: The surface.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        self._scene = engine().mi.load_dict({"type": "scene", "mesh": mitsuba_mesh(mesh.vertices, mesh.faces)})

    def cast(self, origins: Array, directions: Array) -> Hits:
        """Cast rays ``[N, 3]``; directions of any length, what is nearer than a thousandth of it is not seen."""
        used = engine()
        mi, dr = used.mi, used.dr
        if not len(origins):
            return Hits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3)))
        o, d = (np.ascontiguousarray(part.T, dtype=np.float32) for part in (origins, directions))
        ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        ray.o += _NEAR * ray.d
        found = self._scene.ray_intersect_preliminary(ray, coherent=True)
        dr.eval(found.t, found.prim_index, found.prim_uv)
        t = np.array(found.t)
        rays = np.flatnonzero(np.isfinite(t))
        b = np.clip(np.array(found.prim_uv).astype(np.float64).T[rays], 0.0, 1.0)
        b /= np.maximum(b.sum(axis=1, keepdims=True), 1.0)
        weights = np.stack([1.0 - b.sum(axis=1), b[:, 0], b[:, 1]], axis=-1)
        return Hits(
            rays, t[rays].astype(np.float64) + _NEAR, np.array(found.prim_index).astype(np.int64)[rays], weights
        )


def mitsuba_mesh(vertices: Array, faces: NDArray[np.int32]) -> object:
    """A mesh of Mitsuba without normals and texture coordinates; its vertices are its parameter ``vertex_positions``."""
    mi = engine().mi
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    parameters.update()
    return mesh
