"""CARLA as a world. Importing it needs no ``carla``; using it does (``pip install 'advnerf[carla]'``)."""

from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.errors import (
    CarlaBusy,
    CarlaError,
    CarlaFrameError,
    CarlaMapError,
    CarlaNotInstalled,
    CarlaUnreachable,
    CarlaVersionMismatch,
)
from hardware.worlds.carla.scene import CarlaScene

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
