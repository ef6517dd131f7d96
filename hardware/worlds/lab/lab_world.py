"""The simulated lab as a world: the car drives along the tape, past a board and a monitor."""

from __future__ import annotations

import math
from types import TracebackType
from typing import ClassVar, Literal, overload

import numpy as np

from advnerf_core.geometry import Array, Pinhole, VehicleState
from hardware.worlds.footprints import Footprint
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.furniture import obstacles, vehicle_in_room, walls
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import car_mounted_poses, track_pose, walk_around_poses
from hardware.worlds.lab.world import MONITOR_PIXELS
from hardware.worlds.paths import ReferencePath, Segment
from hardware.worlds.world import (
    Box,
    CarDescription,
    Depth,
    NotOpenError,
    Panel,
    Rgb,
    Traits,
    WorldDescription,
    WorldError,
)

HALF_LANE_M = 0.4
FENCE_MARGIN_M = 0.5
# The true car behind the nominal one: how it answers, not what it is asked.
_UNSEEN = (
    "car.true_servo_gain", "car.true_servo_offset", "car.true_erpm_gain", "car.steering_lag_s", "car.steering_slew_radps", "car.motor_lag_s",
    "car.drag_stop_lag_s", "car.friction_mps2", "car.acceleration_per_amp_mps2", "car.grip_mps2", "car.command_delay_s",
)  # fmt: skip


class LabWorld:
    """`hardware.worlds.lab.lab.Lab` behind the contract `hardware.worlds.world.World`.

    Args:
        config: All numbers of the lab.

    Raises:
        TwinUnavailable: When it is opened, MuJoCo or EGL is missing; the message names the packages.
    """

    Config: ClassVar[type[LabConfig]] = LabConfig
    traits: ClassVar[Traits] = Traits(unseen=_UNSEEN, own_photo_colours=True)

    def __init__(self, config: LabConfig | None = None) -> None:
        self.config = given = LabConfig() if config is None else config
        self.camera_pinhole: Pinhole = given.camera.pinhole
        self.photo_pinhole: Pinhole = given.phone.pinhole
        self.T_car_from_camera: Array = given.camera.T_car_from_camera
        self._lab: Lab | None = None

    def describe(self) -> WorldDescription:
        """One closed path: the tape. The box is the room; its panels are the board and the monitor."""
        track, room, car = self.config.track, self.config.room, self.config.car
        straight: Segment = ("line", track.side_m - 2.0 * track.corner_radius_m)
        corner: Segment = ("arc", track.corner_radius_m, 0.5 * math.pi)
        ends = [
            (servo - car.nominal_servo_offset) / car.nominal_servo_gain
            for servo in (car.servo_min, car.servo_max)
        ]
        half = 0.5 * room.side_m
        board, monitor = (
            Panel(each.T_world_from_face, each.width_m, each.height_m, pixels)
            for each, pixels in ((self.config.board, None), (self.config.monitor, MONITOR_PIXELS))
        )
        return WorldDescription(
            paths={
                "track": ReferencePath(
                    track_pose(track, 0.0),
                    (straight, corner) * 4,
                    closed=True,
                    drive_from=self.config.start_pose,
                )
            },
            off_track_m=HALF_LANE_M,
            car=CarDescription("ackermann", car.speed_mps, (min(ends), max(ends)), car.wheelbase_m),
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box((-half, -half, 0.0), (half, half, room.height_m)),
            road_edge=(
                np.array([(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)]),
            ),
            panels={"board": board, "monitor": monitor},
            fence_m=half - FENCE_MARGIN_M,
        )

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """From the car, and on a walk around the room, in turn."""
        driven = car_mounted_poses(self.config, (count + 1) // 2, rng)
        walked = walk_around_poses(self.config, count // 2, rng)
        # Each list goes round once: shuffled, so that any prefix covers the track.
        both = [[each[index] for index in rng.permutation(len(each))] for each in (driven, walked)]
        return [both[index % 2][index // 2] for index in range(count)]

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        return self._open().state

    @property
    def blocked(self) -> bool:
        """Whether the car stands against a wall or an obstacle."""
        return self._open().blocked

    def touches(self, x_m: float, y_m: float, yaw_rad: float) -> str:
        """Name of what the car stands against at a pose; see `hardware.worlds.world.NamesObstacles`. The lab need not be open."""
        return vehicle_in_room(self.config).touches(x_m, y_m, yaw_rad)

    @property
    def car_body(self) -> Footprint:
        """The car's body around its rear axle; see `hardware.worlds.world.HasSolids`."""
        return vehicle_in_room(self.config).body_at(0.0, 0.0, 0.0)

    @property
    def solids(self) -> list[Footprint]:
        """Furniture and walls."""
        return [*obstacles(self.config), *walls(self.config)]

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest."""
        return self._open().reset(x_m, y_m, yaw_rad)

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Send one command, which takes the way of the real driver's, and let time pass."""
        return self._open().step(steering_rad, speed_mps, duration_s)

    @overload
    def observe(self, depth: Literal[True] = True) -> tuple[Rgb, Depth]: ...
    @overload
    def observe(self, depth: Literal[False]) -> tuple[Rgb, None]: ...
    def observe(self, depth: bool = True) -> tuple[Rgb, Depth | None]:
        """What the driving camera sees: colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m], or None if not wanted."""
        return self._open().observe(depth)  # type: ignore[call-overload]

    @overload
    def observe_at(
        self, x_m: float, y_m: float, yaw_rad: float, depth: Literal[True] = True
    ) -> tuple[Rgb, Depth]: ...
    @overload
    def observe_at(
        self, x_m: float, y_m: float, yaw_rad: float, depth: Literal[False]
    ) -> tuple[Rgb, None]: ...
    def observe_at(
        self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True
    ) -> tuple[Rgb, Depth | None]:
        """What the driving camera would see from another pose of the car."""
        return self._open().observe_at(x_m, y_m, yaw_rad, depth)  # type: ignore[call-overload]

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` with the phone's lens."""
        return self._open().photograph(T_world_from_camera)

    def show(self, panel: str, rgb: Rgb | None) -> None:
        """Show a picture on the monitor.

        Raises:
            WorldError: The panel is no screen.
        """
        if panel != "monitor":
            raise WorldError(f"expected a screen of the lab: monitor; got {panel!r}")
        self._open().set_monitor_image(rgb)

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        """Stand a panel in the room; see `Lab.add_panel`."""
        self._open().add_panel(name, panel, rgb)

    @property
    def lab(self) -> Lab:
        """The open lab behind this contract, for what only a lab has: a car that is held, tilted too."""
        return self._open()

    def overview(self) -> tuple[Rgb, Pinhole, Array]:
        """The room from above the south wall, without the ceiling."""
        return self._open().seen_from_above()

    def __enter__(self) -> LabWorld:
        if self._lab is None:
            self._lab = Lab(self.config)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._lab is not None:
            self._lab.close()
            self._lab = None

    def _open(self) -> Lab:
        if self._lab is None:
            raise NotOpenError("expected the lab to be open; it is closed: use it as a context manager")
        return self._lab
