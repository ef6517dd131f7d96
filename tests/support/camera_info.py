from typing import Any

import numpy as np

from advnerf_core.geometry import Pinhole


def pinhole_from_camera_info(message: Any) -> Pinhole:
    """Convert a ``CameraInfo`` to intrinsics with pixel centres at +0.5."""
    K = np.asarray(message.k, dtype=np.float64).reshape(3, 3)
    return Pinhole(int(message.width), int(message.height), K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
