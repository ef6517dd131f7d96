"""Checks that a policy was trained for the calibrated camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.view import PolicyView
from nodes.runtime.errors import ConfigError

_TOLERANCE_PX = 1e-6


def require_camera(view: PolicyView, mounted: Pinhole, policy: str, file: Path | str) -> None:
    """Refuse a policy that was trained for another camera than the one calibrated in ``file``.

    Raises:
        ConfigError: Image size or intrinsics differ.
    """
    trained = view.camera
    same_size = (trained.width, trained.height) == (mounted.width, mounted.height)
    if not same_size or np.abs(trained.matrix - mounted.matrix).max() > _TOLERANCE_PX:
        raise ConfigError(
            f"{file}: expected the camera that the policy {policy} was trained with, {trained}; got {mounted}. Use its "
            "calibration, or train the policy again"
        )
