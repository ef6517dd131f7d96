"""A scene file of opaque, colourful matter that nobody trained, and pictures that cameras take in it."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Array, Pinhole, look_at
from advnerf_core.scene.colour import IDENTITY, ColourMap
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene
from advnerf_core.scene.render_field import FieldRenderer

CAMERA = Pinhole(40, 30, 30.0, 30.0, 20.0, 15.0)
INSIDE = [look_at([0.3 * np.cos(a), 0.3 * np.sin(a), 0.1], [0.0, 0.0, 0.0]) for a in np.linspace(0.0, 5.0, 5)]


def write_scene(path: Path, full: bool = True, half: float = 1.0) -> Path:
    """A box of 2 m, or of twice ``half``, full of matter or empty."""
    grid = HashGridConfig(levels=4, features=2, log2_entries=10, coarsest=4, finest=16)
    field = SceneField(SceneFieldConfig((-half,) * 3, (half,) * 3, grid=grid, hidden=8, features=7))
    with torch.no_grad():
        field.grid.table.normal_(std=0.8, generator=torch.Generator().manual_seed(0))
        field.density_2.bias[0] = 6.0
        field.colour_2.weight.normal_(std=1.5, generator=torch.Generator().manual_seed(1))
    save_scene(path, field, np.full((16, 16, 16), full), {"steps": 3})
    return path


def write_frames(
    scene: Path,
    file: Path,
    poses: Sequence[Array],
    colours: ColourMap = IDENTITY,
    cameras: Sequence[Pinhole] = (),
    names: Sequence[str] = (),
) -> Path:
    """A ``transforms.json`` of pictures that cameras with other colours would take in the scene."""
    renderer = FieldRenderer.from_file(scene)
    cameras, names = cameras or [CAMERA] * len(poses), names or [f"{k}.png" for k in range(len(poses))]
    for pose, camera, name in zip(poses, cameras, names, strict=True):
        rgb = colours.apply(renderer.render(pose[None], camera)[0][0].numpy())
        (file.parent / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file.parent / name), np.rint(255 * rgb[..., ::-1]).astype(np.uint8))
    write_transforms(file, list(names), np.stack(poses), list(cameras), camera_ids=["car"] * len(names))
    return file
