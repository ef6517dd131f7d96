"""CARLA as a deployment scene. Importing it needs no ``carla``; using it does (``pip install 'advnerf[carla]'``)."""

from hardware.carla_scene.config import CarlaConfig
from hardware.carla_scene.errors import (
    CarlaBusy,
    CarlaError,
    CarlaFrameError,
    CarlaMapError,
    CarlaNotInstalled,
    CarlaUnreachable,
    CarlaVersionMismatch,
)
from hardware.carla_scene.scene import CarlaScene

__all__ = [
    "CarlaBusy",
    "CarlaConfig",
    "CarlaError",
    "CarlaFrameError",
    "CarlaMapError",
    "CarlaNotInstalled",
    "CarlaScene",
    "CarlaUnreachable",
    "CarlaVersionMismatch",
]
