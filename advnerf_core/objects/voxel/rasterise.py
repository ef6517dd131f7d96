"""Pictures of a mesh by a depth buffer: targets for fitting and judging a voxel object made from the mesh.

Unlit, like the objects of an attack: a pixel shows the texture. Several rays a pixel are averaged, over colour and coverage.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import Pinhole, invert_transform
from advnerf_core.objects.voxel.mesh import SurfaceMesh
from advnerf_core.parallel import run_slots, slot_bounds

_NEAR_M = 1e-3
_BANDS = 16  # bands of rows, each drawn by one thread


def draw_mesh(
    mesh: SurfaceMesh, T_object_from_camera: ArrayLike, pinhole: Pinhole, supersample: int = 3
) -> NDArray[np.float32]:
    """Premultiplied pictures ``[B, H, W, 4]`` (red, green, blue, coverage) in 0..1.

    Args:
        T_object_from_camera: Camera poses in the mesh's frame ``[B, 4, 4]``, OpenCV axes. Triangles that reach behind a camera
            are left out: stay outside the object.
        supersample: Rays along each side of a pixel.
    """
    poses = np.asarray(T_object_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    triangles = np.concatenate([part.triangles for part in mesh.parts])
    uv = np.concatenate([part.uv for part in mesh.parts])
    part_of = np.repeat(np.arange(len(mesh.parts)), [len(part.triangles) for part in mesh.parts])
    texels, shapes, firsts = _atlas(mesh)
    size = (pinhole.height * supersample, pinhole.width * supersample)
    lens = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy]) * supersample
    images = np.empty((len(poses), pinhole.height, pinhole.width, 4), dtype=np.float32)
    for image, T_camera_from_object in zip(images, invert_transform(poses), strict=True):
        corners = triangles @ T_camera_from_object[:3, :3].T + T_camera_from_object[:3, 3]
        fine = np.zeros((*size, 4), dtype=np.float32)
        _draw(corners, uv, part_of, texels, shapes, firsts, lens, np.full(size, np.inf), fine)
        image[:] = fine.reshape(pinhole.height, supersample, pinhole.width, supersample, 4).mean(axis=(1, 3))
    return images


def _draw(*arguments: Any) -> None:
    """Draw all rows, in bands, with the arguments of `_draw_band`."""
    bands, draw_band = slot_bounds(len(arguments[-1]), _BANDS), cast(Any, _draw_band)
    run_slots(lambda band: draw_band(*arguments, *bands[band]), _BANDS)


def _atlas(mesh: SurfaceMesh) -> tuple[Any, Any, Any]:
    """All textures as one list of texels, with the shape and the first texel of each."""
    shapes = np.array([part.texture.shape[:2] for part in mesh.parts], dtype=np.int64)
    firsts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]]).astype(np.int64)
    return np.concatenate([part.texture.reshape(-1, 3) for part in mesh.parts]), shapes, firsts


@njit(cache=True, error_model="numpy", forceinline=True)
def _edge(a: Any, b: Any, x: float, y: float) -> float:
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _draw_band(
    corners: Any,
    uv: Any,
    part_of: Any,
    texels: Any,
    shapes: Any,
    firsts: Any,
    lens: Any,
    depth: Any,
    image: Any,
    top: int,
    bottom: int,
) -> None:
    """Draw rows from ``top`` to before ``bottom``."""
    width = depth.shape[1]
    p = np.empty((3, 2))
    for f in range(len(corners)):
        c = corners[f]
        if c[0, 2] < _NEAR_M or c[1, 2] < _NEAR_M or c[2, 2] < _NEAR_M:
            continue
        for k in range(3):
            p[k, 0] = lens[0] * c[k, 0] / c[k, 2] + lens[2]
            p[k, 1] = lens[1] * c[k, 1] / c[k, 2] + lens[3]
        area = _edge(p[0], p[1], p[2, 0], p[2, 1])
        if area == 0.0:
            continue
        first_row = max(top, int(np.floor(min(p[0, 1], p[1, 1], p[2, 1]) - 0.5)))
        last_row = min(bottom, int(np.ceil(max(p[0, 1], p[1, 1], p[2, 1]) + 0.5)))
        first_column = max(0, int(np.floor(min(p[0, 0], p[1, 0], p[2, 0]) - 0.5)))
        last_column = min(width, int(np.ceil(max(p[0, 0], p[1, 0], p[2, 0]) + 0.5)))
        part = part_of[f]
        for v in range(first_row, last_row):
            for u in range(first_column, last_column):
                a = _edge(p[1], p[2], u + 0.5, v + 0.5) / area
                b = _edge(p[2], p[0], u + 0.5, v + 0.5) / area
                if a < 0.0 or b < 0.0 or a + b > 1.0:
                    continue
                # Planar depth is not linear in the image, its inverse is; so are texture coordinates over depth.
                wa, wb, wc = a / c[0, 2], b / c[1, 2], (1.0 - a - b) / c[2, 2]
                z = 1.0 / (wa + wb + wc)
                if z >= depth[v, u]:
                    continue
                depth[v, u] = z
                s = z * (wa * uv[f, 0, 0] + wb * uv[f, 1, 0] + wc * uv[f, 2, 0])
                t = z * (wa * uv[f, 0, 1] + wb * uv[f, 1, 1] + wc * uv[f, 2, 1])
                s, t = s - np.floor(s), t - np.floor(t)
                column = min(int(s * shapes[part, 1]), shapes[part, 1] - 1)
                row = min(int((1.0 - t) * shapes[part, 0]), shapes[part, 0] - 1)
                texel = firsts[part] + row * shapes[part, 1] + column
                for k in range(3):
                    image[v, u, k] = texels[texel, k]
                image[v, u, 3] = 1.0
