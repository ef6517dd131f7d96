"""Images between tensors and pixels."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray


def as_uint8(image: torch.Tensor) -> NDArray[np.uint8]:
    """Image ``[3, H, W]`` in 0..1 as uint8 ``[H, W, 3]``."""
    return np.ascontiguousarray((image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())
