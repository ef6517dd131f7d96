"""A world in another process for tests: the numpy-only simulator beside this file, served by ``serve.py`` or by one that misbehaves."""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from advnerf_core.geometry import Array, Pinhole, camera_mount, look_at, planar_pose
from hardware.worlds.fitting import path_through
from hardware.worlds.remote import SERVERS
from hardware.worlds.remote_world import RemoteMeshWorld, ServerDeadlines
from hardware.worlds.world import Box, CarDescription, WorldDescription

HERE = Path(__file__).parent
SIMULATOR, FAULTY = HERE / "flat_simulator.py", HERE / "faulty_server.py"
HALF_LANE_M = 0.6


class FlatConfig(BaseModel):
    """Numbers of the world.

    Attributes:
        seed: Of its colours.
        width: Of the driving camera's image [px].
        height: Of it [px].
        speed_mps: Speed of drives [m/s].
        server: Deadlines.
        faulty: Folder in which ``fault.json`` says what goes wrong; none for a server in order.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = 1
    width: int = 336
    height: int = 188
    speed_mps: float = 1.2
    server: ServerDeadlines = Field(default=ServerDeadlines(), exclude=True)
    faulty: Path | None = Field(default=None, exclude=True)


class FlatWorld(RemoteMeshWorld):
    """A chequered floor with posts about a round lane."""

    Config: ClassVar[type[FlatConfig]] = FlatConfig

    def __init__(self, config: FlatConfig) -> None:
        self.config = config
        simulator, server = SIMULATOR, SERVERS / "serve.py"
        if config.faulty is not None:
            simulator, server = config.faulty / SIMULATOR.name, FAULTY
            if not simulator.exists():
                shutil.copy(SIMULATOR, simulator)
        cameras = centred(config.width, config.height, 88.0), centred(400, 240, 90.0)
        mount = camera_mount(0.4, 0.0, 0.5, math.radians(10.0))
        settings = {"seed": config.seed}
        super().__init__(
            "flat", simulator, settings, cameras, mount, (0.05, 60.0), deadlines=config.server, server=server
        )

    def python(self) -> Path:
        """The interpreter of the tests, which has pyzmq and numpy."""
        return Path(sys.executable)

    def description_of(self, facts: dict[str, Any], arrays: dict[str, Any]) -> WorldDescription:
        """The round lane."""
        return WorldDescription(
            paths={"round": path_through(arrays["lane"], closed=True)},
            off_track_m=HALF_LANE_M,
            car=CarDescription("ackermann", self.config.speed_mps, (-0.5, 0.5), facts["wheelbase_m"]),
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box((-14.0, -14.0, 0.0), (14.0, 14.0, 4.0), contraction=True),
        )

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Along the lane, every fifth one from above."""
        path, poses = self.describe().paths["round"], []
        for index in range(count):
            x, y, yaw = path.pose_at(float(rng.uniform(0.0, path.length_m)))
            if index % 5 == 4:
                poses.append(look_at([x, y, 2.0], [0.3 * x + 1.0, 0.3 * y, 0.0]))
            else:
                pose = planar_pose(x, y, yaw + float(rng.normal(0.0, 0.3)))
                poses.append(pose @ camera_mount(0.4, 0.0, 0.6, 0.2))
        return poses


def centred(width: int, height: int, fov_deg: float) -> Pinhole:
    """Square pixels, the principal point in the middle."""
    focal_px = 0.5 * width / math.tan(0.5 * math.radians(fov_deg))
    return Pinhole(width, height, focal_px, focal_px, 0.5 * width, 0.5 * height)


def plan_fault(folder: Path, call: str, kind: str, after: int = 0) -> None:
    """Have the server in a folder misbehave, once, at a later call."""
    (folder / "fault.json").write_text(json.dumps({"call": call, "kind": kind, "after": after}))
