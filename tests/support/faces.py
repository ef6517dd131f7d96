"""Attack files of one face, and those of the simulated lab that are one red square, which no picture of the room has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.attack.artifact import (
    COLOURS,
    AttackedObject,
    AttackFace,
    AttackFile,
    face_texture,
    save_attack,
)
from advnerf_core.geometry import Array, Pinhole
from calibration.panel import target_size
from calibration.schema import TargetCalibration, load_calibration

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
_OF_NO_SEARCH = {
    "camera": Pinhole(200, 66, 103.6, 103.4, 100, 32),
    "scene_sha256": "",
    "policy_sha256": "",
    "config_sha256": "",
    "seed": 0,
    "predicted_total_cte_m": None,
    "software_version": "0",
}


def face_attack(
    *,
    theta: Any,
    size_m: tuple[float, float],
    subject: str,
    corners_in_subject: Array,
    T_world_from_object: Array,
    texture: Any = None,
    name: str = "face",
    sha256: str = "",
    **others: Any,
) -> AttackFile:
    """The attack file of one face; ``others`` are its other attributes, else those of no search."""
    carrier = AttackedObject(name, theta, T_world_from_object, 1.0, sha256)  # it refuses what has no texture
    shown = face_texture(theta) if texture is None else texture
    return AttackFile(
        space=COLOURS,
        objects=(carrier,),
        face=AttackFace(shown, size_m, subject, corners_in_subject),
        **{**_OF_NO_SEARCH, **others},
    )


def centre_square(target: TargetCalibration) -> TargetCalibration:
    """Make a target from the largest centred square of a panel, which an attack on a monitor may use."""
    corners, (width, height) = target.corners, target_size(target)
    middle, half = corners.mean(axis=0), 0.5 * min(width, height)
    right, up = (corners[1] - corners[0]) / width, (corners[0] - corners[3]) / height
    square = [middle + half * (x * right + y * up) for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    rows = tuple(tuple(round(float(v), 6) for v in corner) for corner in square)
    return target.model_copy(update={"corners_in_subject_m": rows, "notes": "centre square of the panel"})


def reordered(target: TargetCalibration, order: tuple[int, ...]) -> TargetCalibration:
    """Make a target whose corners were given in another order."""
    rows = tuple(target.corners_in_subject_m[index] for index in order)
    return target.model_copy(update={"corners_in_subject_m": rows})


def outward_normal(target: TargetCalibration) -> Array:
    """Unit vector ``[3]`` out of the face, towards a viewer in front of it, in the subject's frame."""
    normal = np.cross(target.corners[3] - target.corners[0], target.corners[1] - target.corners[0])
    return normal / np.linalg.norm(normal)


def red_attack(folder: Path, subject: str) -> tuple[AttackFile, Path]:
    """The attack, and its file in a folder: all of the board, or the square in the middle of the monitor."""
    target = load_calibration(TargetCalibration, TWIN / f"{subject}.yaml")
    corners = target.corners if subject == "board" else centre_square(target).corners
    side_m = 1.0 if subject == "board" else 0.3362
    attack = face_attack(
        method="random",
        theta=np.zeros((4, 4, 3), np.float32),
        texture=np.full((64, 64, 3), (250, 0, 0), np.uint8),
        size_m=(side_m, side_m),
        T_world_from_object=np.eye(4),
        subject=subject,
        corners_in_subject=corners,
    )
    file = folder / "red.attack.safetensors"
    save_attack(file, attack)
    return attack, file
