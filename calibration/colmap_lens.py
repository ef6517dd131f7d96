"""Converts COLMAP's camera models to a pinhole and a lens of the data sets.

Pixel centres are at +0.5 in both. COLMAP defines its models in ``src/colmap/sensor/models.h``.
"""

from __future__ import annotations

from typing import Any

from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Pinhole

# Their coefficients are the first ones of k1, k2, p1, p2, or of a fisheye's k1, k2, k3, k4.
_BROWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def lens_of(camera: Any) -> tuple[Pinhole, Lens] | None:
    """Intrinsics of a COLMAP camera; None if its model has no `Lens`.

    Raises:
        ValueError: The camera's size or parameters are impossible.
    """
    name = camera.model_name
    extra = [float(camera.params[index]) for index in camera.extra_params_idxs()]
    if name == "FULL_OPENCV" and not any(extra[5:]):
        lens = Lens(tuple(extra[:5]))
    elif name in _BROWN:
        lens = Lens((*extra, *[0.0] * (5 - len(extra))))
    elif name in _FISHEYE:
        lens = Lens((*extra, *[0.0] * (4 - len(extra))), fisheye=True)
    else:
        return None
    return pinhole_of(camera), lens


def pinhole_of(camera: Any) -> Pinhole:
    """Size, focal lengths and principal point of a COLMAP camera."""
    focal = float(camera.focal_length_x), float(camera.focal_length_y)
    centre = float(camera.principal_point_x), float(camera.principal_point_y)
    return Pinhole(int(camera.width), int(camera.height), *focal, *centre)
