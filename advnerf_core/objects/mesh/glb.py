"""Attacked meshes as GLB files: geometry, texture coordinates and the attacked texture, for any viewer, printer or simulator.

glTF has y up; axes are converted when writing and reading. The texture is 8 bits a channel, which is how a re-read mesh
differs. Viewers light it; it was attacked unlit.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.surface import TexturedMesh
from advnerf_core.objects.voxel.mesh import MeshError

_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def write_glb(path: Path, mesh: TexturedMesh) -> None:
    """Write a mesh with its texture, whole or not at all."""
    write_atomically(path, glb_bytes(mesh))


def glb_bytes(mesh: TexturedMesh) -> bytes:
    """The content of a GLB file of a mesh with its texture; the same mesh gives the same bytes."""
    import trimesh
    from PIL import Image

    height, width = mesh.texture.shape[:2]
    # A vertex has one place in the texture: vertices on the seams of charts are written once for each chart.
    texels = np.ascontiguousarray(mesh.texels.reshape(-1, 2))
    keys = np.concatenate([mesh.faces.reshape(-1, 1).astype(np.float64), texels], axis=1)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    vertices = mesh.vertices[mesh.faces.reshape(-1)[first]] @ _Y_UP_FROM_Z_UP.T
    uv = texels[first] / [width, height]
    uv[:, 1] = 1.0 - uv[:, 1]  # trimesh counts from the bottom
    pixels = np.round(255.0 * np.clip(mesh.texture, 0.0, 1.0)).astype(np.uint8)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(pixels), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    out: Any = trimesh.Trimesh(vertices, place.reshape(-1, 3), visual=visual, process=False)
    content: bytes = out.export(file_type="glb")
    return content


def read_glb(path: Path) -> TexturedMesh:
    """Read a file of :func:`write_glb`; texture coordinates are kept. For other files use ``objects.mesh.load_mesh`` and ``unwrapped``.

    Raises:
        MeshError: The file is missing, or is not a single mesh with a texture.
    """
    if not path.is_file():
        raise MeshError(f"expected a GLB file at {path}, found none")
    return mesh_from_glb(path.read_bytes(), str(path))


def mesh_from_glb(content: bytes, source: str) -> TexturedMesh:
    """The mesh of a GLB file's content; see `read_glb`. ``source`` names it in errors."""
    import trimesh

    try:
        parts = list(
            trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False).geometry.values()
        )
        (part,) = parts
        uv = np.asarray(part.visual.uv, dtype=np.float64)
        pixels = np.asarray(part.visual.material.baseColorTexture.convert("RGB"))
        faces = np.asarray(part.faces, dtype=np.int64)
    except Exception as error:  # trimesh's readers raise any exception
        raise MeshError(
            f"expected {source} to be one mesh with one texture, as 'advnerf attack run' writes it ({type(error).__name__}: {error})"
        ) from error
    height, width = pixels.shape[:2]
    texels = np.stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height], axis=-1)[faces]
    vertices, welded = _welded(np.asarray(part.vertices, dtype=np.float64) @ _Y_UP_FROM_Z_UP, faces)
    charts = np.zeros((height, width), np.int16)
    return TexturedMesh(vertices, welded, texels, pixels.astype(np.float32) / np.float32(255.0), charts)


def _welded(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int32]]:
    """Merge vertices with equal bits: vertices on seams were written more than once."""
    unique, place = np.unique(vertices, axis=0, return_inverse=True)
    return unique, place.reshape(-1)[faces].astype(np.int32)
