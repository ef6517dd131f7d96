"""Decodes colours and depth from the BGRA bytes of a ``carla.Image``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.worlds.carla.errors import CarlaFrameError

# CARLA's sensor reference, "Depth camera": planar depth in 24 bits of R (least), G, B, from 0 to the far plane.
FAR_M = 1000.0
_STEPS = 256**3 - 1
# The sky is at the far plane; nothing in a map is that far, and a filter at an edge may reduce the value a little.
_NOTHING_M = 0.999 * FAR_M


def rgb_of(image: Any, width: int, height: int) -> NDArray[np.uint8]:
    """Colours ``[H, W, 3]`` of a camera image, copied.

    Raises:
        CarlaFrameError: The image does not have the requested size.
    """
    return np.ascontiguousarray(_bgra(image, width, height)[..., 2::-1])


def depth_of(image: Any, width: int, height: int) -> NDArray[np.float32]:
    """Planar depth ``[H, W]`` [m] of a depth camera's raw image; infinite where nothing is.

    ``depth = 1000 m (R + 256 G + 65536 B) / (2^24 - 1)``: steps of 0.06 mm.

    Raises:
        CarlaFrameError: The image does not have the requested size.
    """
    bgra = _bgra(image, width, height).astype(np.uint32)
    steps = bgra[..., 2] + 256 * bgra[..., 1] + 65536 * bgra[..., 0]
    depth_m = steps * (FAR_M / _STEPS)
    return np.where(depth_m < _NOTHING_M, depth_m, np.inf).astype(np.float32)


def _bgra(image: Any, width: int, height: int) -> NDArray[np.uint8]:
    data = np.frombuffer(image.raw_data, dtype=np.uint8)
    if (image.width, image.height) != (width, height) or data.size != width * height * 4:
        raise CarlaFrameError(
            f"expected an image of {width} x {height} pixels in BGRA, got {image.width} x {image.height} in {data.size} bytes"
        )
    return data.reshape(height, width, 4)
