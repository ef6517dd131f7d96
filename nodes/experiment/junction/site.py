"""Where an experiment of the junction is captured and deployed: the simulated one, or one of a CARLA map."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array, look_at
from advnerf_core.scene.field import SceneFieldConfig
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.drives import Drives
from hardware.worlds.carla.photos import photo_poses as carla_photo_poses
from hardware.worlds.junction.config import IntersectionConfig
from hardware.worlds.junction.paths import PathName, ReferencePath
from hardware.worlds.junction.photos import photo_poses
from hardware.worlds.world import DeploymentScene
from nodes.runtime.errors import ConfigError

DRIVES = "drives.json"
# Cameras, car and objects have the same names in both.
World: TypeAlias = IntersectionConfig | CarlaConfig
_SCENE_HEIGHT_M = 20.0  # of the box that a CARLA scene is learned in; what is beyond is contracted


class Site(Protocol):
    """A place with three drives through a junction."""

    @property
    def world(self) -> World:
        """Its configuration."""
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """What of the configuration the results depend on, as JSON data."""
        ...

    @property
    def references(self) -> dict[PathName, ReferencePath]:
        """The drives."""
        ...

    @property
    def lanes(self) -> tuple[ReferencePath, ...]:
        """Middles of the lanes in which nothing may stand: at least the drives'."""
        ...

    @property
    def off_track_m(self) -> float:
        """Cross-track error beyond which the car has left its lane [m]."""
        ...

    @property
    def road_edge(self) -> tuple[float, Callable[[float, float], bool]] | None:
        """Half of the world's side [m] and whether a point is on the road, for drawing; None where it is not known."""
        ...

    def open(self) -> DeploymentScene:
        """The scene; the caller closes it."""
        ...

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """From where it is photographed for learning, ``T_world_from_camera`` ``[4, 4]`` each."""
        ...

    def field_config(self, grid: HashGridConfig, margin_m: float) -> SceneFieldConfig:
        """The box that is learned."""
        ...

    def overview(self, scene: DeploymentScene) -> NDArray[np.uint8]:
        """A picture of the junction from above, for reports."""
        ...


@dataclass(frozen=True)
class TwinSite:
    """The simulated junction; nothing needs to be installed or started for it.

    Attributes:
        world: Its configuration.
    """

    world: IntersectionConfig

    @property
    def settings(self) -> dict[str, Any]:
        """All of the configuration."""
        return self.world.model_dump(mode="json")

    @cached_property
    def references(self) -> dict[PathName, ReferencePath]:
        """The drives that follow from the roads' measures."""
        return self.world.paths()

    @property
    def lanes(self) -> tuple[ReferencePath, ...]:
        """All lanes: a lane's width about them is the whole asphalt."""
        return self.world.lanes()

    @property
    def off_track_m(self) -> float:
        """Half a lane."""
        return self.world.off_track_m

    @property
    def road_edge(self) -> tuple[float, Callable[[float, float], bool]]:
        """The asphalt."""
        return self.world.road.half_m, self.world.on_road

    def open(self) -> DeploymentScene:
        """Render and drive with MuJoCo, which is imported only now."""
        from hardware.worlds.junction.scene import Intersection

        return Intersection(self.world)

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Along, beside and above the drives."""
        return photo_poses(self.world, count, rng)

    def field_config(self, grid: HashGridConfig, margin_m: float) -> SceneFieldConfig:
        """A box around the world, its painted sky included: nothing lies outside."""
        half, sky = self.world.road.half_m + margin_m, self.world.road.sky_m + margin_m
        return SceneFieldConfig((-half, -half, -margin_m), (half, half, sky), grid)

    def overview(self, scene: DeploymentScene) -> NDArray[np.uint8]:
        """From above the south, with paths and objects drawn in."""
        picture: NDArray[np.uint8] = scene.overview()  # type: ignore[attr-defined]  # the twin's own
        return picture


@dataclass(frozen=True)
class CarlaSite:
    """A junction of a CARLA map. Where its drives are is known once the server was asked; it is kept in the capture stage's folder.

    Attributes:
        world: Its configuration.
        folder: Folder of the capture stage.
        library: The ``carla`` module; None imports it.
    """

    world: CarlaConfig
    folder: Path
    library: Any = None

    @property
    def settings(self) -> dict[str, Any]:
        """The configuration without the server's address and patience; its map counts."""
        data: dict[str, Any] = self.world.model_dump(mode="json", exclude={"server"})
        return {**data, "town": self.world.server.town}

    @cached_property
    def drives(self) -> Drives:
        """Junction, frame and lanes as the capture found them.

        Raises:
            ConfigError: Nothing is captured yet.
        """
        file = self.folder / DRIVES
        if not file.exists():
            raise ConfigError(
                f"expected {file}, which the capture stage writes when the CARLA server is asked; run that stage first"
            )
        return Drives.from_dict(json.loads(file.read_text(encoding="utf-8")))

    @property
    def references(self) -> dict[PathName, ReferencePath]:
        """The lanes of the map."""
        return self.drives.paths

    @property
    def lanes(self) -> tuple[ReferencePath, ...]:
        """The drives; what else is asphalt the map does not say."""
        return tuple(self.drives.paths.values())

    @property
    def off_track_m(self) -> float:
        """Half of the narrowest lane."""
        return 0.5 * self.drives.lane_width_m

    @property
    def road_edge(self) -> None:
        """CARLA's map has lanes, no kerbs."""
        return

    def open(self) -> DeploymentScene:
        """Connect to the server, and see that the junction is that of the capture; the first time it becomes that.

        Raises:
            CarlaError: Something is wrong with the server.
            ConfigError: Its drives are not those that were captured.
        """
        from hardware.worlds.carla.scene import CarlaScene

        scene = CarlaScene(self.world, self.library)
        try:
            found, file = json.loads(json.dumps(scene.drives.to_dict())), self.folder / DRIVES
            if not file.exists():
                write_atomically(file, json.dumps(found, indent=1) + "\n")
            elif json.loads(file.read_text(encoding="utf-8")) != found:
                raise ConfigError(
                    f"the server's junction is not that of {file}: load the map it was captured from, or use another run folder"
                )
        except BaseException:
            scene.close()
            raise
        return scene

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Along, beside and above the drives, no farther from them than a lane."""
        return carla_photo_poses(self.drives, self.world, count, rng)

    def field_config(self, grid: HashGridConfig, margin_m: float) -> SceneFieldConfig:
        """A box around what is driven through; the town and the sky beyond are contracted."""
        half = self.world.junction.reach_m
        return SceneFieldConfig((-half, -half, -margin_m), (half, half, _SCENE_HEIGHT_M), grid, contraction=True)

    def overview(self, scene: DeploymentScene) -> NDArray[np.uint8]:
        """A photograph from above the drives' start."""
        return scene.photograph(look_at(np.array([-18.0, 0.0, 22.0]), np.zeros(3)))
