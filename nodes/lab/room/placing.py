"""Live guide for moving the board or monitor to the pose for which its attack was computed, or the attack to the measured pose."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.live import Live

from advnerf_core.attack.artifact import AttackFile
from advnerf_core.documents import dump_yaml, read_yaml
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array
from calibration.placement import Misplacement, measured_pose, misplacement
from calibration.schema import TargetCalibration
from nodes.lab.room.live import standing_poses
from nodes.runtime.console import plain_console
from nodes.runtime.errors import ConfigError
from nodes.runtime.terminal import table

_PANEL_M = 2.0  # edge of a face at scale 1 whose request gives none
_TILT = ("pitch_rad", "roll_rad")


def guide(
    run_dir: Path,
    attack: AttackFile,
    target: TargetCalibration,
    limits: tuple[float, float],
    once: bool,
    timeout_s: float,
) -> tuple[Misplacement, Array] | None:
    """Show the displacement live until the target is in place, or until the timeout.

    Args:
        target: Corners of the target that shows it.
        limits: Tolerated distance [m] and angle [rad].

    Returns:
        The last displacement and the subject's pose ``[4, 4]``; None if the subject was never seen.
    """
    found, deadline = None, time.monotonic() + timeout_s
    with Live(console=plain_console(stderr=True), refresh_per_second=4, transient=True) as live:
        for T in standing_poses(run_dir, f"/vicon/{target.subject}", 0.5):
            if T is None:
                live.update(f"{target.subject} is lost")
            else:
                off = misplacement(attack, target, T)
                found = off, T
                live.update(_placement_table(off, limits))
                if once or off.within(*limits):
                    break
            if time.monotonic() > deadline:
                break
    return found


def _placement_table(off: Misplacement, limits: tuple[float, float]) -> Any:
    colour = "green" if off.within(*limits) else "red"
    rows = table("", f"{in_short(off)} off: move it")
    rows.columns[1].header_style = colour
    for name, advice in off.advice():
        rows.add_row(name, advice)
    return rows


def in_short(off: Misplacement) -> str:
    """Format distance and angle."""
    return f"{100 * off.distance_m:.1f} cm and {np.rad2deg(off.angle_rad):.1f} deg"


def say_how_to_attack_again(
    request: Path | None, target: TargetCalibration, T_world_from_subject: Array
) -> None:
    """Print the command for an attack at the measured pose. With a request, also write the request."""
    pose = measured_pose(target, T_world_from_subject)
    if request is None:
        print(
            "its face is at "
            + ", ".join(f"{key}: {value}" for key, value in pose.items())
            + "; give --request to write a file"
        )
    else:
        print(f"advnerf attack run {write_measured_request(request, pose)}")


def write_measured_request(request: Path, pose: dict[str, float]) -> Path:
    """Write a copy of an experiment, in the same folder, with the measured pose of the face.

    Args:
        request: A ``*.experiment.yaml`` file with one panel or cube that has a face.
        pose: Pose of the face's middle: ``x_m``, ``y_m``, ``z_m`` and ``yaw_rad``.

    Returns:
        The new file. Its relative paths stay valid, because it is in the same folder.
    """
    data = read_yaml(request).data
    objects = data.get("objects") if isinstance(data, dict) else None
    faces = [each for each in objects or [] if isinstance(each, dict) and isinstance(each.get("face"), dict)]
    if len(faces) != 1:
        raise ConfigError(
            f"{request}: expected one object with the section face, got {len(faces)}; change the pose by hand"
        )
    (face,) = faces
    for key in _TILT:
        face.pop(key, None)
    side_m = face.get("scale", 1.0) * face["face"].get("size_m", _PANEL_M)
    face.update(pose | {"z_m": round(pose["z_m"] - 0.5 * side_m, 6)})
    stem = request.name.removesuffix(".yaml").removesuffix(".experiment")
    output = request.with_name(f"{stem}.measured.experiment.yaml")
    write_atomically(output, dump_yaml(data))
    return output
