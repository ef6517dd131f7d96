"""The room as files: MJCF and pictures, for programs that are not in this process."""

from __future__ import annotations

import cv2
import numpy as np

from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.world import compose_room

SCENE = "room.xml"


def room_as_files(config: LabConfig) -> dict[str, bytes]:
    """The scene of `hardware.worlds.lab.world.build_model` without the car, which the car's own cameras never draw.

    Returns:
        Contents by name: ``room.xml`` (MJCF), and one PNG for each texture, which it names.
    """
    spec, files = compose_room(config), {}
    spec.delete(spec.body("car"))
    for texture in spec.textures:
        name, shape = f"{texture.name}.png", (texture.height, texture.width, texture.nchannel)
        rgb = np.frombuffer(bytes(texture.data), np.uint8).reshape(shape)
        files[name] = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()
        # MJCF names files; it cannot hold the bytes of a picture.
        texture.file, texture.data = name, b""
        spec.assets[name] = files[name]
    spec.compile()
    return {SCENE: spec.to_xml().encode(), **files}
