"""Writes an experiment for the measured pose of its face, as an alternative to moving the face."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.documents import dump_yaml, read_yaml
from advnerf_core.files import write_atomically
from nodes.runtime.errors import ConfigError

_PANEL_M = 2.0  # edge of a face at scale 1 whose request gives none
_TILT = ("pitch_rad", "roll_rad")


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
