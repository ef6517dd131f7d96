"""An empty box room of smooth colours, whose pictures are known in closed form."""

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.views import ImageSet
from advnerf_core.geometry import Array, Pinhole, look_at

HALF = np.array([1.0, 1.0, 0.5])
CAMERA = Pinhole(48, 36, 30.0, 30.0, 24.0, 18.0)


def room_view(T: Array) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Image and planar depth from inside an empty box room whose colours vary smoothly with position."""
    directions = CAMERA.directions() @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        t = ((np.sign(directions) * HALF - T[:3, 3]) / directions).min(-1)
    hit = T[:3, 3] + t[..., None] * directions
    rgb = 0.5 + 0.4 * np.sin(
        7.0 * hit[..., [0, 1, 2]] + 5.0 * hit[..., [1, 2, 0]] + np.array([0.0, 1.0, 2.0])
    )
    return np.round(255 * rgb).astype(np.uint8), t


def room_poses(count: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    eyes = rng.uniform(-0.6, 0.6, (count, 3)) * HALF
    return np.stack(
        [look_at(eye, eye + np.append(rng.normal(size=2), rng.uniform(-0.5, 0.5))) for eye in eyes]
    )


def room_images(count: int = 90, seed: int = 0) -> ImageSet:
    poses = room_poses(count, seed)
    return ImageSet(np.stack([room_view(T)[0] for T in poses]), (CAMERA,) * count, poses)
