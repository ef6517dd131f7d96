"""Reads GLB files of attacked meshes again, texture coordinates kept: what was written is what was found."""

from __future__ import annotations

import io

import numpy as np
import trimesh
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.surface import TexturedMesh

_Z_UP_FROM_Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def mesh_from_glb(content: bytes) -> TexturedMesh:
    """The mesh of a file of `glb_bytes`."""
    (part,) = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False).geometry.values()
    uv = np.asarray(part.visual.uv, dtype=np.float64)
    pixels = np.asarray(part.visual.material.baseColorTexture.convert("RGB"))
    faces = np.asarray(part.faces, dtype=np.int64)
    height, width = pixels.shape[:2]
    texels = np.stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height], axis=-1)[faces]
    vertices, welded = _welded(np.asarray(part.vertices, dtype=np.float64) @ _Z_UP_FROM_Y_UP.T, faces)
    charts = np.zeros((height, width), np.int16)
    return TexturedMesh(vertices, welded, texels, pixels.astype(np.float32) / np.float32(255.0), charts)


def _welded(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int32]]:
    """Merge vertices with equal bits: vertices on seams were written more than once."""
    unique, place = np.unique(vertices, axis=0, return_inverse=True)
    return unique, place.reshape(-1)[faces].astype(np.int32)
