"""Places that are driven. `WORLDS` names those that this project brings; the contract is `hardware.worlds.world.World`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from advnerf_core.lazy import lazy_names

__all__ = [
    "WORLDS",
    "Box",
    "CarDescription",
    "CarlaConfig",
    "CarlaScene",
    "Intersection",
    "IntersectionConfig",
    "Lab",
    "LabConfig",
    "ReferencePath",
    "World",
    "WorldDescription",
]

if TYPE_CHECKING:
    from hardware.worlds.carla.config import CarlaConfig
    from hardware.worlds.carla.scene import CarlaScene
    from hardware.worlds.junction.config import IntersectionConfig
    from hardware.worlds.junction.scene import Intersection
    from hardware.worlds.lab.config import LabConfig
    from hardware.worlds.lab.lab import Lab
    from hardware.worlds.paths import ReferencePath
    from hardware.worlds.world import Box, CarDescription, World, WorldClass, WorldDescription
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "hardware.worlds.carla.config": "CarlaConfig",
            "hardware.worlds.carla.scene": "CarlaScene",
            "hardware.worlds.junction.config": "IntersectionConfig",
            "hardware.worlds.junction.scene": "Intersection",
            "hardware.worlds.lab.config": "LabConfig",
            "hardware.worlds.lab.lab": "Lab",
            "hardware.worlds.paths": "ReferencePath",
            "hardware.worlds.world": "Box CarDescription World WorldDescription",
        },
    )

ENTRY_POINTS = "advnerf.worlds"


def _lab() -> WorldClass:
    from hardware.worlds.lab.lab_world import LabWorld

    return LabWorld


def _junction() -> WorldClass:
    from hardware.worlds.junction.scene import Intersection

    return Intersection


def _carla() -> WorldClass:
    from hardware.worlds.carla.scene import CarlaScene

    return CarlaScene


def _metadrive() -> WorldClass:
    from hardware.worlds.metadrive.world import MetaDrive

    return MetaDrive


def _duckietown() -> WorldClass:
    from hardware.worlds.duckietown.world import Duckietown

    return Duckietown


def _filament() -> WorldClass:
    from hardware.worlds.filament.world import Filament

    return Filament


WORLDS: Mapping[str, Callable[[], WorldClass]] = {
    "lab": _lab,
    "junction": _junction,
    "carla": _carla,
    "metadrive": _metadrive,
    "duckietown": _duckietown,
    "filament": _filament,
}
"""Loaders of the worlds' classes by name; a simulator is imported when its world is opened."""
