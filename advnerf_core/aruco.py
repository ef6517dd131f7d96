"""Square markers as OpenCV names them."""

from __future__ import annotations

from typing import Any

import cv2

from advnerf_core.errors import ConfigError


def marker_dictionary(name: str) -> Any:
    """OpenCV's dictionary of markers with a name such as ``DICT_APRILTAG_36h11``.

    Raises:
        ConfigError: There is none with this name.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        raise ConfigError(
            f"expected a marker dictionary such as DICT_4X4_50 or DICT_APRILTAG_36h11, got {name!r}"
        )
    return cv2.aruco.getPredefinedDictionary(number)
