"""Checks that a policy was trained for the calibrated camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.view import PolicyView
from nodes.runtime.errors import ConfigError

# A declaration may be rounded; a picture does not show this.
_TOLERANCE_PX = 0.01


def same_camera(one: Pinhole, other: Pinhole) -> bool:
    """Whether two cameras have the same size, and the same intrinsics but for rounding."""
    same_size = (one.width, one.height) == (other.width, other.height)
    return same_size and float(np.abs(one.matrix - other.matrix).max()) <= _TOLERANCE_PX


def require_camera(view: PolicyView, mounted: Pinhole, policy: str, file: Path | str) -> None:
    """Refuse a policy that was trained for another camera than the one calibrated in ``file``.

    Raises:
        ConfigError: Image size or intrinsics differ.
    """
    if not same_camera(view.camera, mounted):
        raise ConfigError(
            f"{file}: expected the camera that the policy {policy} was trained with, {view.camera}; got {mounted}. Use its "
            "calibration, or train the policy again"
        )
