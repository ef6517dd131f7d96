"""Photograph a junction: posed images for learning, and views of the driving camera that nothing learns from."""

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
    """What to photograph.

    Attributes:
        photos: Photographs that the scene is learned from; the paper has 1800.
        held_out: Views of the driving camera along the drives.
    """

    photos: int = 1800
    held_out: int = 60
    seed: int = 0


def capture(
    config: CarlaConfig, request: CaptureRequest, folder: Path, report: Report, library: Any = None
) -> tuple[int, int]:
    """Write ``photos`` and ``held_out`` (images and ``transforms.json``) and ``drives.json`` (frame and reference paths).

    A capture that was stopped goes on: pictures that are there are kept. They are in the scene's frame: right-handed, metres, z up.

    Args:
        folder: Where to; one that holds another capture is refused.
        report: Gets the share done and what is being done.
        library: The ``carla`` module; None imports it.

    Returns:
        How many pictures were taken now, and how many were there.

    Raises:
        ConfigError: The folder holds a capture of something else.
        CarlaError: Something is wrong with the server.
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
    """Note what is captured into a folder, or see that it is the same as before; the server's address does not count."""
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
