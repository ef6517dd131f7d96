"""The places that can be driven. `WORLDS` lists the built-in ones; the contract is `hardware.worlds.world.World`."""

from __future__ import annotations

import importlib
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


def _loader(module: str, name: str) -> Callable[[], WorldClass]:
    return lambda: getattr(importlib.import_module(f"{__name__}.{module}"), name)


WORLDS: Mapping[str, Callable[[], WorldClass]] = {
    "lab": _loader("lab.lab", "Lab"),
    "junction": _loader("junction.scene", "Intersection"),
    "carla": _loader("carla.scene", "CarlaScene"),
    "metadrive": _loader("metadrive.world", "MetaDrive"),
    "duckietown": _loader("duckietown.world", "Duckietown"),
    "filament": _loader("filament.world", "Filament"),
}
"""Loaders of the worlds' classes by name; a simulator is imported when its world is opened."""
