"""Photographs of the simulated lab by its driving camera, as a user's folder holds them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.geometry import Array, planar_pose
from hardware.worlds.lab.lab import Lab
from hardware.worlds.paths import Pose


def photograph(
    lab: Lab, states: Sequence[Pose], folder: Path, T_images_from_lab: Array | None = None
) -> None:
    """Write posed images that an open lab's car takes at its states, in the lab's frame or another."""
    T = np.eye(4) if T_images_from_lab is None else T_images_from_lab
    write_posed_images(
        folder,
        [T @ planar_pose(*state) @ lab.T_car_from_camera for state in states],
        lab.camera_pinhole,
        lambda index: lab.observe_at(*states[index], depth=False)[0],
        "png",
    )
