"""Places that are driven: the lab, the junction, CARLA."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advnerf_core.lazy import lazy_names

__all__ = [
    "CarlaConfig",
    "CarlaScene",
    "DeploymentScene",
    "Intersection",
    "IntersectionConfig",
    "Lab",
    "LabConfig",
]

if TYPE_CHECKING:
    from hardware.worlds.carla.config import CarlaConfig
    from hardware.worlds.carla.scene import CarlaScene
    from hardware.worlds.junction.config import IntersectionConfig
    from hardware.worlds.junction.scene import Intersection
    from hardware.worlds.lab.config import LabConfig
    from hardware.worlds.lab.lab import Lab
    from hardware.worlds.world import DeploymentScene
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
            "hardware.worlds.world": "DeploymentScene",
        },
    )
