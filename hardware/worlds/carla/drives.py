"""The drives through a junction of a CARLA map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hardware.worlds.carla.frames import SceneFrame
from hardware.worlds.junction.paths import PathName
from hardware.worlds.paths import ReferencePath


@dataclass(frozen=True)
class JunctionDrives:
    """The three drives, in the scene's own frame: x along the straight drive, origin in the junction's middle on the ground.

    The frame and the names match the simulated intersection: straight leaves to the east, right to the south; left comes
    from the south and leaves to the west.

    Attributes:
        junction_id: OpenDRIVE id of the junction.
        frame: The scene's frame in CARLA's world.
        paths: Straight, right and left.
        lane_width_m: Width of the narrowest lane driven on [m].
        height_range_m: Highest minus lowest point of all three drives [m].
        right_hand: Whether traffic keeps to the right.
    """

    junction_id: int
    frame: SceneFrame
    paths: dict[PathName, ReferencePath]
    lane_width_m: float
    height_range_m: float
    right_hand: bool

    @property
    def place(self) -> dict[str, Any]:
        """Id and position of the junction, as JSON data."""
        T = self.frame.T_mirrored_from_world
        return {
            "junction_id": self.junction_id,
            "frame": {"x_m": T[0, 3], "y_m": T[1, 3], "z_m": T[2, 3], "yaw_rad": self.frame.yaw_rad},
            "height_range_m": self.height_range_m,
            "right_hand": self.right_hand,
        }
