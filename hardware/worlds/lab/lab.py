"""The simulated lab, synchronous: observe, decide, step, as fast as it goes. Lab time passes only in ``step``."""

from __future__ import annotations

from types import TracebackType
from typing import Literal, overload

import numpy as np

from advnerf_core.geometry import Array, Pinhole, VehicleState, look_at, planar_pose
from hardware.worlds.lab import textures
from hardware.worlds.lab.config import LabConfig, MonitorOpticsConfig
from hardware.worlds.lab.driven import DrivenCar
from hardware.worlds.lab.monitor import ScreenOptics
from hardware.worlds.lab.phone import apply_colours
from hardware.worlds.lab.renderer import Renderer
from hardware.worlds.lab.world import CAR_GROUP, CEILING_GROUP, MONITOR_PIXELS, build_model
from hardware.worlds.world import Depth, Panel, Rgb


class Lab:
    """A room with a car in it.

    The same configuration and the same calls give the same bytes on one machine. A ``Lab`` owns an OpenGL context: use
    it in the thread that made it, and close it or use it as a context manager.

    Args:
        config: All numbers of the lab.

    Raises:
        TwinUnavailable: MuJoCo or EGL is missing; the message names the packages.
    """

    def __init__(self, config: LabConfig | None = None) -> None:
        self.config = LabConfig() if config is None else config
        self.camera_pinhole: Pinhole = self.config.camera.pinhole
        self.phone_pinhole: Pinhole = self.config.phone.pinhole
        self.photo_pinhole: Pinhole = self.phone_pinhole
        self.T_car_from_camera: Array = self.config.camera.T_car_from_camera
        self._car = DrivenCar(self.config)
        self._stood: dict[str, tuple[Panel, Rgb]] = {}
        self._shown: dict[str, Rgb] = {}  # textures that are no longer those of the model
        self._renderer = self._new_renderer()
        # None where colours are seen as they are shown: nothing to compute from frame to frame.
        self._optics: ScreenOptics | None = None
        if self.config.monitor_optics != MonitorOpticsConfig():
            self._optics = ScreenOptics(self.config.monitor_optics, self.config.monitor, MONITOR_PIXELS)
        self._screen_seen_from: Array | None = None
        if self._optics is not None:
            self.set_monitor_image(None)

    def _new_renderer(self) -> Renderer:
        model = build_model(self.config, self._stood)
        return Renderer(model, self.config.supersampling, hidden_groups=(CAR_GROUP,))

    def reset(self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float = 0.0) -> VehicleState:
        """Put the car down, forget commands under way and start lab time at 0; a speed, if given, is held."""
        return self._car.reset(x_m, y_m, yaw_rad, speed_mps)

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Send one command and let time pass.

        The command goes the way of the real driver's: nominal gains, servo clipped to its limits, speeds below the motor
        controller's minimum become a drag stop; and it reaches the actuators ``car.command_delay_s`` after this call.

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

    @overload
    def observe(self, depth: Literal[True] = True) -> tuple[Rgb, Depth]: ...
    @overload
    def observe(self, depth: Literal[False]) -> tuple[Rgb, None]: ...
    def observe(self, depth: bool = True) -> tuple[Rgb, Depth | None]:
        """What the driving camera sees now.

        Args:
            depth: Whether depth is wanted too; it costs about half as much again.

        Returns:
            Colour image ``[H, W, 3]`` uint8 and planar depth ``[H, W]`` float32 [m], or None.
        """
        return self._see(planar_pose(*self._pose()), depth)

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
        """What the driving camera would see from another pose of the car (see :meth:`observe`); the car stays where it is."""
        return self._see(planar_pose(x_m, y_m, yaw_rad), depth)

    def observe_held(self, T_world_from_car: Array) -> Rgb:
        """What the driving camera sees ``[H, W, 3]`` while a person holds the car at any pose ``[4, 4]``, tilted too."""
        return self._see(T_world_from_car, depth=False)[0]

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """Take a phone photo ``[H, W, 3]`` uint8 with ``phone_pinhole`` and the phone's own colours."""
        self._light_screen(T_world_from_camera)
        rgb = self._renderer.render_rgb(T_world_from_camera, self.phone_pinhole)
        return apply_colours(rgb, self.config.phone)

    def overview(self, width: int = 960, height: int = 720) -> Rgb:
        """Picture ``[height, width, 3]`` of the whole room and the car from above the south wall, without the ceiling, for reports."""
        return self.seen_from_above(width, height)[0]

    def seen_from_above(self, width: int = 960, height: int = 720) -> tuple[Rgb, Pinhole, Array]:
        """The picture of :meth:`overview`, and the camera that took it: intrinsics and ``T_world_from_camera`` ``[4, 4]``."""
        focal = 1.04 * width
        pinhole = Pinhole(width, height, focal, focal, 0.5 * width, 0.5 * height)
        side = self.config.room.side_m
        T = look_at([0.0, -1.12 * side, 1.12 * side], [0.0, -0.3, 0.0])
        self._renderer.place("car", planar_pose(*self._pose()), hidden_groups=(CEILING_GROUP,))
        try:
            return self._renderer.render_rgb(T, pinhole), pinhole, T
        finally:
            self._renderer.place("car", np.eye(4), hidden_groups=(CAR_GROUP,))

    def subject_poses(self) -> dict[str, Array]:
        """What motion capture sees: ``T_world_from_subject`` ``[4, 4]`` of "car", "board" and "monitor"."""
        return {
            "car": planar_pose(*self._pose()),
            "board": self.config.board.T_world_from_face,
            "monitor": self.config.monitor.T_world_from_face,
        }

    def set_board_image(self, rgb: Rgb | None) -> None:
        """Show a picture ``[h, w, 3]`` on the board's face (row 0 on top); None makes it plain again."""
        plain = np.full((2, 2, 3), self.config.board.rgb, dtype=np.float32)
        self._set_texture("board", textures.to_uint8(plain) if rgb is None else rgb)

    def set_monitor_image(self, rgb: Rgb | None) -> None:
        """Show a picture ``[h, w, 3]`` on the whole monitor (row 0 on top); None shows the idle screen again."""
        shown = textures.to_uint8(textures.screen_image(256, 144)) if rgb is None else rgb
        if self._optics is None:
            self._set_texture("monitor", shown)
            return
        self._optics.show(shown)
        self._screen_seen_from = None

    def add_panel(self, name: str, panel: Panel, rgb: Rgb | None) -> None:
        """Stand a panel in the room, lit as the furniture is, or take it out; see `hardware.worlds.world.NativePanels`.

        A new picture on a panel that stands there takes no time; anything else builds the room again. Nothing collides with it.

        Args:
            name: Of the panel.
            panel: Pose and size.
            rgb: Texture ``[h, w, 3]`` uint8, row 0 on top; None takes the panel out.
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
        """Another model; what board and monitor show stays."""
        self._renderer.close()
        self._renderer = self._new_renderer()
        for name, rgb in self._shown.items():
            self._renderer.set_texture(name, rgb)

    def _set_texture(self, name: str, rgb: Rgb) -> None:
        self._shown[name] = np.array(rgb)
        self._renderer.set_texture(name, rgb)

    def close(self) -> None:
        """Free the OpenGL context; safe to call twice."""
        self._renderer.close()

    def __enter__(self) -> Lab:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _pose(self) -> tuple[float, float, float]:
        state = self._car.state
        return state.x_m, state.y_m, state.yaw_rad

    def _see(self, T_world_from_car: Array, depth: bool) -> tuple[Rgb, Depth | None]:
        T = T_world_from_car @ self.T_car_from_camera
        self._light_screen(T)
        rgb = self._renderer.render_rgb(T, self.camera_pinhole)
        return rgb, self._renderer.render_depth(T, self.camera_pinhole) if depth else None

    def _light_screen(self, T_world_from_camera: Array) -> None:
        """Give the monitor the colours that are seen from where the camera is."""
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
