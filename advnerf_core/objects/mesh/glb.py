"""Attacked meshes as GLB files: geometry, texture coordinates and the attacked texture, for any viewer, printer or simulator.

glTF has y up and z to the front; axes are converted. The texture has 8 bits a channel. Viewers light it; it was attacked unlit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from advnerf_core.objects.mesh.surface import TexturedMesh
from advnerf_core.objects.voxel.mesh import Z_UP_FROM_Y_UP


def glb_bytes(mesh: TexturedMesh) -> bytes:
    """The content of a GLB file of a mesh with its texture; the same mesh gives the same bytes."""
    import trimesh
    from PIL import Image

    height, width = mesh.texture.shape[:2]
    # A vertex has one place in the texture: vertices on the seams of charts are written once for each chart.
    texels = np.ascontiguousarray(mesh.texels.reshape(-1, 2))
    keys = np.concatenate([mesh.faces.reshape(-1, 1).astype(np.float64), texels], axis=1)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    vertices = mesh.vertices[mesh.faces.reshape(-1)[first]] @ Z_UP_FROM_Y_UP
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
