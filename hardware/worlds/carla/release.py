"""Releases a world that a killed client left in synchronous mode."""

from __future__ import annotations

from typing import Any

from hardware.worlds.carla.config import ServerConfig
from hardware.worlds.carla.connection import connect
from hardware.worlds.carla.library import load_carla, server_answers


def release(server: ServerConfig, library: Any = None) -> bool:
    """Switch the world back to running freely, with changing traffic lights; False if it already ran.

    Raises:
        CarlaUnreachable: No server answers.
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
