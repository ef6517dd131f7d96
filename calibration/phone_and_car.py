"""Places a model from phone and driving-camera images in the motion-capture world.

Structure from motion leaves scale and frame open. Frames of a driven bag in the same model have poses in both worlds: the model's, and
the car's motion-capture pose at the capture stamp times the camera's mounting pose. The similarity between the two gives scale and frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.data.similarity import Alignment, align_poses
from advnerf_core.geometry import Array
from calibration.photo_model import Model, ReconstructionError

_MIN_SHARED = 6
# Largest angle of a frame from its motion-capture pose [rad].
_TOLERANCE_RAD = math.radians(3.0)
# With a smaller share of the car's frames in place the result is refused.
_MIN_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Placed:
    """A model in the motion-capture world.

    Attributes:
        T_world_from_camera: Poses of the model's images ``[N, 4, 4]``, in its order [m].
        points: Points of the scene ``[M, 3]`` [m].
        alignment: The similarity and its residuals over the shared frames.
        shared: Names of the car's frames that are in the model.
    """

    T_world_from_camera: Array
    points: Array
    alignment: Alignment
    shared: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Facts for the report."""
        a = self.alignment
        frames = [
            {
                "image": name,
                "used": bool(used),
                "position_error_m": float(far),
                "rotation_error_rad": float(angle),
            }
            for name, used, far, angle in zip(
                self.shared, a.inliers, a.position_error_m, a.rotation_error_rad, strict=True
            )
        ]
        return {**a.summary(), "frames": frames}


def place_in_mocap(
    model: Model, T_world_from_camera: Mapping[str, Array], tolerance_m: float = 0.08
) -> Placed:
    """Put a model into the world of motion capture.

    Args:
        model: Images of the phone and of the car.
        T_world_from_camera: Motion-capture pose ``[4, 4]`` of every frame of the car, by its name in the model.
        tolerance_m: Largest distance of a correctly placed frame from its motion-capture pose [m].

    Raises:
        ReconstructionError: Too few of the car's frames are in the model.
        SimilarityError: Their poses determine no similarity: on one line, or too few agree.
    """
    shared = [image for image in model.images if image.name in T_world_from_camera]
    if len(shared) < _MIN_SHARED:
        raise ReconstructionError(
            f"expected at least {_MIN_SHARED} frames of the car in one model with the phone's pictures, got {len(shared)} of "
            f"{len(T_world_from_camera)}; film at the car's height along its track too, so that both see the same things from alike places"
        )
    alignment = align_poses(
        np.stack([image.T_world_from_camera for image in shared]),
        np.stack([T_world_from_camera[image.name] for image in shared]),
        tolerance_m,
        _TOLERANCE_RAD,
        _MIN_SHARE,
    )
    similarity = alignment.similarity
    return Placed(
        similarity.poses(model.poses),
        similarity.points(model.points),
        alignment,
        tuple(image.name for image in shared),
    )
