"""Photographs a junction: posed images for learning, and held-out views of the driving camera."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from advnerf_core.geometry import planar_pose
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.photos import held_out_states, photo_poses
from hardware.worlds.carla.scene import CarlaScene
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report, counted

PHOTOS, HELD_OUT, DRIVES, REQUEST = "photos", "held_out", "drives.json", "request.json"


@dataclass(frozen=True)
class CaptureRequest:
    """Amount of pictures to take.

    Attributes:
        photos: Photographs for learning the scene; the paper has 1800.
        held_out: Views of the driving camera along the drives.
    """

    photos: int = 1800
    held_out: int = 60
    seed: int = 0


def capture(
    config: CarlaConfig, request: CaptureRequest, folder: Path, report: Report, library: Any = None
) -> tuple[int, int]:
    """Write ``photos`` and ``held_out`` (images and ``transforms.json``) and ``drives.json`` (frame and reference paths).

    An interrupted capture resumes: existing pictures are kept. They are in the scene's frame: right-handed, metres, z up.

    Args:
        folder: Output folder; an error if it holds another capture.
        library: The ``carla`` module; None imports it.

    Returns:
        Number of pictures taken in this call, and of pictures that existed.

    Raises:
        ConfigError: The folder holds another capture.
        CarlaError: The server failed.
    """
    with CarlaScene(config, library) as scene:
        drives = scene.drives.to_dict()
        _claim(folder, config, request, drives)
        rng = np.random.default_rng(request.seed)
        poses = photo_poses(scene.drives, config, request.photos, rng)
        states = held_out_states(scene.drives, request.held_out, rng)
        write_json(folder / DRIVES, drives)
        total = len(poses) + len(states)

        taken = write_posed_images(
            folder / PHOTOS,
            poses,
            scene.photo_pinhole,
            lambda i: scene.photograph(poses[i]),
            "jpg",
            keep=True,
            told=counted(report, PHOTOS, len(poses), 0, total),
        )
        taken += write_posed_images(
            folder / HELD_OUT,
            [planar_pose(*s) @ scene.T_car_from_camera for s in states],
            scene.camera_pinhole,
            lambda i: scene.observe_at(*states[i], depth=False)[0],
            "png",
            keep=True,
            told=counted(report, HELD_OUT, len(states), len(poses), total),
        )
    return taken, total - taken


def _claim(folder: Path, config: CarlaConfig, request: CaptureRequest, drives: dict[str, Any]) -> None:
    """Note the capture's settings in a folder, or check that they are the same as before; the server's address does not count."""
    about = config.model_dump(mode="json", exclude={"server", "car", "body"}) | {"town": config.server.town}
    text = json.dumps({"config": about, "request": vars(request), "drives": drives}, sort_keys=True)
    digest, file = hashlib.sha256(text.encode()).hexdigest(), folder / REQUEST
    if file.exists():
        if read_json(file).get("sha256") != digest:
            raise ConfigError(
                f"{folder} holds a capture with other settings: name another folder, or remove it"
            )
        return
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(f"{folder} is not empty and holds no capture: name another folder")
    write_json(file, {"sha256": digest, **json.loads(text)})
