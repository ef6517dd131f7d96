"""The simulated lab, synchronous: observe, decide, step, as fast as it goes. Lab time passes only in ``step``.

The car drives along the tape, past a board and a monitor.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from advnerf_core.geometry import Array, Pinhole, VehicleState, look_at
from hardware.worlds.footprints import Footprint
from hardware.worlds.lab import textures
from hardware.worlds.lab.config import LabConfig, MonitorOpticsConfig
from hardware.worlds.lab.driven import DrivenCar
from hardware.worlds.lab.furniture import obstacles, vehicle_in_room, walls
from hardware.worlds.lab.monitor import ScreenOptics
from hardware.worlds.lab.phone import apply_colours, car_mounted_poses, track_pose, walk_around_poses
from hardware.worlds.lab.renderer import Renderer
from hardware.worlds.lab.world import CAR_GROUP, CEILING_GROUP, MONITOR_PIXELS, build_model
from hardware.worlds.paths import ReferencePath, Segment
from hardware.worlds.seen import SeenWorld
from hardware.worlds.world import (
    Box,
    CarDescription,
    NotOpenError,
    Panel,
    Rgb,
    Traits,
    View,
    WorldDescription,
    WorldError,
)

HALF_LANE_M = 0.4
FENCE_MARGIN_M = 0.5
# The true car's response to commands; the nominal car and the commands do not depend on it.
_UNSEEN = (
    "car.true_servo_gain", "car.true_servo_offset", "car.true_erpm_gain", "car.steering_lag_s", "car.steering_slew_radps", "car.motor_lag_s",
    "car.drag_stop_lag_s", "car.friction_mps2", "car.acceleration_per_amp_mps2", "car.grip_mps2", "car.command_delay_s",
)  # fmt: skip


class Lab(SeenWorld):
    """A room with a car in it; a `hardware.worlds.world.World`.

    The same configuration and the same calls give the same bytes on one machine. While it is open it owns an OpenGL context: use
    it in the thread that opened it.

    Args:
        config: All numbers of the lab.

    Raises:
        TwinUnavailable: When it is opened, MuJoCo or EGL is missing; the message names the packages.
    """

    Config: ClassVar[type[LabConfig]] = LabConfig
    traits: ClassVar[Traits] = Traits(unseen=_UNSEEN, own_photo_colours=True)

    def __init__(self, config: LabConfig | None = None) -> None:
        self.config = LabConfig() if config is None else config
        self.camera_pinhole: Pinhole = self.config.camera.pinhole
        self.photo_pinhole: Pinhole = self.config.phone.pinhole
        self.T_car_from_camera: Array = self.config.camera.T_car_from_camera
        self._car = DrivenCar(self.config)
        self._stood: dict[str, tuple[Panel, Rgb]] = {}
        self._shown: dict[str, Rgb] = {}  # textures that differ from the model's
        self._open_renderer: Renderer | None = None
        # None where the optics are the identity: nothing to compute per frame.
        self._optics: ScreenOptics | None = None
        if self.config.monitor_optics != MonitorOpticsConfig():
            self._optics = ScreenOptics(self.config.monitor_optics, self.config.monitor, MONITOR_PIXELS)
        self._screen_seen_from: Array | None = None

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
        """Poses ``T_world_from_camera [4, 4]`` from the car, and on a walk around the room, in turn."""
        driven = car_mounted_poses(self.config, (count + 1) // 2, rng)
        walked = walk_around_poses(self.config, count // 2, rng)
        # Each list is used once: shuffled, so that any prefix covers the track.
        both = [[each[index] for index in rng.permutation(len(each))] for each in (driven, walked)]
        return [both[index % 2][index // 2] for index in range(count)]

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

    def reset(self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float = 0.0) -> VehicleState:
        """Put the car down, forget commands under way and start lab time at 0; a speed, if given, is held."""
        return self._car.reset(x_m, y_m, yaw_rad, speed_mps)

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Send one command and let time pass.

        The command passes through a model of the real driver: nominal gains, servo clipped to its limits, speeds below the motor
        controller's minimum become a drag stop; it reaches the actuators ``car.command_delay_s`` after this call.

        Args:
            steering_rad: Commanded wheel angle, left positive [rad].
            speed_mps: Commanded speed [m/s].
            duration_s: Time to the next observation [s].
        """
        return self._car.step(steering_rad, speed_mps, duration_s)

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        return self._car.state

    @property
    def time_s(self) -> float:
        """Lab time since the last reset [s]."""
        return self._car.time_s

    @property
    def blocked(self) -> bool:
        """Whether the car stands against a wall or an obstacle."""
        return self._car.blocked

    def observe_held(self, T_world_from_car: Array) -> Rgb:
        """View of the driving camera ``[H, W, 3]`` while a person holds the car at any pose ``[4, 4]``, tilted too."""
        return self._see(T_world_from_car, depth=False)[0]

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """Take a phone photo ``[H, W, 3]`` uint8 with ``photo_pinhole`` and the phone's own colours."""
        self._light_screen(T_world_from_camera)
        rgb = self._renderer.render_rgb(T_world_from_camera, self.photo_pinhole)
        return apply_colours(rgb, self.config.phone)

    def overview(self, width: int = 960, height: int = 720) -> tuple[Rgb, Pinhole, Array]:
        """The room and the car from above the south wall, without the ceiling, and the camera: its intrinsics and ``T_world_from_camera`` ``[4, 4]``."""
        focal = 1.04 * width
        pinhole = Pinhole(width, height, focal, focal, 0.5 * width, 0.5 * height)
        side = self.config.room.side_m
        T = look_at([0.0, -1.12 * side, 1.12 * side], [0.0, -0.3, 0.0])
        self._renderer.place("car", self.state.T_world_from_car, hidden_groups=(CEILING_GROUP,))
        try:
            return self._renderer.render_rgb(T, pinhole), pinhole, T
        finally:
            self._renderer.place("car", np.eye(4), hidden_groups=(CAR_GROUP,))

    def show(self, panel: str, rgb: Rgb | None) -> None:
        """Show a picture ``[h, w, 3]`` on the whole monitor (row 0 on top); None shows the idle screen again.

        Raises:
            WorldError: The panel is no screen.
        """
        if panel != "monitor":
            raise WorldError(f"expected a screen of the lab: monitor; got {panel!r}")
        shown = textures.to_uint8(textures.screen_image(256, 144)) if rgb is None else rgb
        if self._optics is None:
            self._set_texture("monitor", shown)
            return
        self._optics.show(shown)
        self._screen_seen_from = None

    def set_board_image(self, rgb: Rgb | None) -> None:
        """Show a picture ``[h, w, 3]`` on the board's face (row 0 on top); None makes it plain again."""
        plain = np.full((2, 2, 3), self.config.board.rgb, dtype=np.float32)
        self._set_texture("board", textures.to_uint8(plain) if rgb is None else rgb)

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        """Add a panel to the room, lit like the furniture, or remove it; see `hardware.worlds.world.NativePanels`.

        A new picture on an existing panel takes no time; anything else rebuilds the room. Nothing collides with the panel.

        Args:
            panel: Pose and size.
            rgb: Texture ``[h, w, 3]`` uint8, row 0 on top; None removes the panel.
        """
        texture, before = f"panel {name}", self._stood.get(f"panel {name}")
        if rgb is None:
            if before is not None:
                del self._stood[texture]
                self._rebuild()
            return
        self._stood[texture] = panel, np.array(rgb, dtype=np.uint8)
        if before is not None and _same_place(before[0], panel) and before[1].shape == rgb.shape:
            self._renderer.set_texture(texture, rgb)
        else:
            self._rebuild()

    def _rebuild(self) -> None:
        """Rebuild the model; board and monitor keep their pictures."""
        self._renderer.close()
        self._open_renderer = self._new_renderer()
        for name, rgb in self._shown.items():
            self._renderer.set_texture(name, rgb)

    def _new_renderer(self) -> Renderer:
        model = build_model(self.config, self._stood)
        return Renderer(model, self.config.supersampling, hidden_groups=(CAR_GROUP,))

    @property
    def _renderer(self) -> Renderer:
        if self._open_renderer is None:
            raise NotOpenError("expected the lab to be open; it is closed: use it as a context manager")
        return self._open_renderer

    def _set_texture(self, name: str, rgb: Rgb) -> None:
        self._shown[name] = np.array(rgb)
        self._renderer.set_texture(name, rgb)

    def close(self) -> None:
        """Free the OpenGL context; safe to call twice."""
        if self._open_renderer is not None:
            self._open_renderer.close()
            self._open_renderer = None
        self._stood.clear()
        self._shown.clear()
        self._screen_seen_from = None

    def __enter__(self) -> Lab:
        if self._open_renderer is None:
            self._car, self._open_renderer = DrivenCar(self.config), self._new_renderer()
            if self._optics is not None:
                self.show("monitor", None)
        return self

    def _see(self, T_world_from_car: Array, depth: bool) -> View:
        T = T_world_from_car @ self.T_car_from_camera
        self._light_screen(T)
        rgb = self._renderer.render_rgb(T, self.camera_pinhole)
        return rgb, self._renderer.render_depth(T, self.camera_pinhole) if depth else None

    def _light_screen(self, T_world_from_camera: Array) -> None:
        """Give the monitor the colours seen from the camera's position."""
        if self._optics is None:
            return
        place = T_world_from_camera[:3, 3]
        before = self._screen_seen_from
        if before is not None and (not self._optics.depends_on_place or np.array_equal(before, place)):
            return
        self._set_texture("monitor", self._optics.seen_from(place))
        self._screen_seen_from = np.array(place)


def _same_place(one: Panel, other: Panel) -> bool:
    same_size = (one.width_m, one.height_m) == (other.width_m, other.height_m)
    return same_size and np.array_equal(one.T_world_from_face, other.T_world_from_face)
