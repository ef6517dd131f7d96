"""A box's inner corner with painted walls, photographed by any camera: photographs whose poses and lenses are known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Array, Pinhole, look_at

WALL_M = 3.0


def _painting(seed: int) -> NDArray[np.float32]:
    """Random blocks of several sizes: corners at every scale."""
    rng = np.random.default_rng(seed)
    image = np.zeros((900, 900, 3), np.float32)
    for cells, weight in ((9, 0.4), (30, 0.35), (90, 0.25)):
        blocks = rng.uniform(0.0, 255.0, (cells, cells, 3)).astype(np.float32)
        image += weight * cv2.resize(blocks, (900, 900), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)


WALLS = [_painting(seed) for seed in range(3)]


def photograph(T_world_from_camera: Array, pinhole: Pinhole, lens: Lens) -> NDArray[np.uint8]:
    """Cast a ray through every pixel of the distorted image onto the planes x = 0, y = 0, z = 0; colours ``[H, W, 3]``."""
    columns, rows = np.meshgrid(np.arange(pinhole.width, dtype=float), np.arange(pinhole.height, dtype=float))
    matrix = pinhole.matrix.copy()
    matrix[:2, 2] -= 0.5
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, matrix, np.array(lens.coefficients)).reshape(-1, 2)
    directions = np.column_stack([straight, np.ones(len(straight))]) @ T_world_from_camera[:3, :3].T
    origin, image, nearest = (
        T_world_from_camera[:3, 3],
        np.zeros((len(straight), 3)),
        np.full(len(straight), np.inf),
    )
    for axis in range(3):
        with np.errstate(divide="ignore"):
            distance = -origin[axis] / directions[:, axis]
        u, v = ((origin + distance[:, None] * directions)[:, other] for other in range(3) if other != axis)
        hit = (distance > 0) & (distance < nearest) & (u >= 0) & (u < WALL_M) & (v >= 0) & (v < WALL_M)
        if not hit.any():
            continue
        nearest[hit] = distance[hit]
        maps = ((900 / WALL_M * each[hit]).astype(np.float32).reshape(-1, 1) for each in (u, v))
        # In rows of one pixel; OpenCV's maps may not be longer than 32767.
        x, y = maps
        parts = [
            cv2.remap(WALLS[axis], a, b, cv2.INTER_LINEAR)
            for a, b in zip(np.array_split(x, 8), np.array_split(y, 8), strict=True)
        ]
        image[hit] = np.concatenate(parts).reshape(-1, 3)
    return np.rint(image).clip(0, 255).astype(np.uint8).reshape(pinhole.height, pinhole.width, 3)


def poses_of(count: int, radius_m: float, height_m: float, first_rad: float, last_rad: float) -> list[Array]:
    """Poses ``T_world_from_camera`` on an arc round the corner that look at its middle."""
    angles = np.linspace(first_rad, last_rad, count)
    return [look_at([radius_m * np.cos(a), radius_m * np.sin(a), height_m], [0.7, 0.7, 0.6]) for a in angles]


def some_camera(rng: np.random.Generator, longer_side_px: int) -> tuple[Pinhole, Lens]:
    """A camera as people have them: focal length 0.7 to 1.3 of the longer side, a little radial distortion, its own size."""
    width = round(longer_side_px * rng.uniform(0.8, 1.0))
    height = round(width * rng.choice([2 / 3, 3 / 4, 9 / 16]))
    f = width * rng.uniform(0.7, 1.3)
    k1 = rng.uniform(-0.12, 0.06)
    return Pinhole(width, height, f, f, 0.5 * width, 0.5 * height), Lens((k1, -0.3 * k1, 0.0, 0.0, 0.0))


def write_photographs(
    folder: Path, poses: Sequence[Array], cameras: Sequence[tuple[Pinhole, Lens]]
) -> dict[str, tuple[Array, Pinhole]]:
    """Write a photograph from each pose by each camera; their poses and pinholes by name."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = {}
    for index, (pose, (pinhole, lens)) in enumerate(zip(poses, cameras, strict=True)):
        name = f"{index:02d}.png"
        if not cv2.imwrite(str(folder / name), photograph(pose, pinhole, lens)[..., ::-1]):
            raise OSError(f"expected to write {folder / name}")
        truth[name] = (pose, pinhole)
    return truth
