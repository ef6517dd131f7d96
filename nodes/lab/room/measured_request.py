"""Writes an attack request for the measured pose of the face, as an alternative to moving the face."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.documents import dump_yaml, read_yaml
from advnerf_core.files import write_atomically
from nodes.runtime.errors import ConfigError

_POSE_KEYS = ("T_world_from_object", "x_m", "y_m", "z_m", "yaw_rad")


def write_measured_request(request: Path, pose: dict[str, float]) -> Path:
    """Write a copy of a request, in the same folder, with the measured pose of the face.

    Args:
        request: A ``*.attack.yaml`` file with one object of kind ``face``.
        pose: ``x_m``, ``y_m``, ``z_m`` and ``yaw_rad``.

    Returns:
        The new file. Its relative paths stay valid, because it is in the same folder.
    """
    data = read_yaml(request).data
    objects = data.get("objects") if isinstance(data, dict) else None
    faces = [each for each in objects or [] if isinstance(each, dict) and each.get("kind") == "face"]
    if len(faces) != 1:
        raise ConfigError(
            f"{request}: expected one object of kind face, got {len(faces)}; change the pose by hand"
        )
    for key in _POSE_KEYS:
        faces[0].pop(key, None)
    faces[0].update(pose)
    stem = request.name.removesuffix(".yaml").removesuffix(".attack")
    output = request.with_name(f"{stem}.measured.attack.yaml")
    write_atomically(output, dump_yaml(data))
    return output
