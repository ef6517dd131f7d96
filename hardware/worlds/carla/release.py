"""Freeing a world that a killed client left standing still."""

from __future__ import annotations

from typing import Any

from hardware.worlds.carla.config import ServerConfig
from hardware.worlds.carla.connection import connect
from hardware.worlds.carla.library import load_carla, server_answers


def release(server: ServerConfig, library: Any = None) -> bool:
    """Let the world tick by itself again, and its traffic lights change; False if it did so already.

    Raises:
        CarlaUnreachable: There is no server, or it does not answer.
    """
    client = connect(server, load_carla() if library is None else library)
    with server_answers("freeing its world"):
        world = client.get_world()
        settings = world.get_settings()
        if not settings.synchronous_mode:
            return False
        settings.synchronous_mode, settings.fixed_delta_seconds = False, None
        world.apply_settings(settings)
        world.freeze_all_traffic_lights(False)
    return True
