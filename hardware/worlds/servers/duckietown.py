"""Duckietown (duckietown-gym-daffy 6.1.34) for ``serve.py``: a map by name, a camera with depth, and its differential drive with delay.

Runs in Duckietown's environment, and imports nothing of advnerf. Duckietown's y points up and its z to the south; here x and y lie on
the ground and z points up: (x, y, z) is its (x, -z, y). Headings are the same.
"""

from __future__ import annotations

import collections
import collections.abc
import math
from typing import Any

import numpy as np
import pyglet

# Its packages were written for Python 3.9 and numpy 1.19, which had these names.
for name in (
    "Mapping",
    "MutableMapping",
    "Sequence",
    "Iterable",
    "Hashable",
    "Callable",
    "Set",
    "MutableSet",
):
    setattr(collections, name, getattr(collections.abc, name))
for name, kind in (("bool", bool), ("int", int), ("float", float), ("object", object)):
    if name not in np.__dict__:
        setattr(np, name, kind)
pyglet.options["headless"] = True
pyglet.options["audio"] = ("silent",)

import geometry  # noqa: E402 - of Duckietown's packages, which need the names above
from duckietown_world.world_duckietown.dynamics_delay import ApplyDelay  # noqa: E402
from duckietown_world.world_duckietown.pwm_dynamics import PWMCommands, get_DB18_nominal  # noqa: E402
from gym_duckietown.simulator import CAMERA_FORWARD_DIST, Simulator, get_agent_corners  # noqa: E402
from pyglet_camera import PygletMesh, PygletPanel, PygletView, taken_from, to_opengl  # noqa: E402

STEP_S, DELAY_S = 0.02, 0.15
_CURVE_POINTS, _JOINED_M = 12, 0.01
Reply = tuple[dict[str, Any], dict[str, np.ndarray]]


def open_simulator(config: dict[str, Any], cameras: dict[str, Any]) -> Map:
    """The simulator of one map."""
    return Map(config, cameras)


class Map:
    """One map of Duckietown; see docs/worlds.md for the calls."""

    def __init__(self, config: dict[str, Any], cameras: dict[str, Any]) -> None:
        self._sim = Simulator(
            map_name=config["map_name"], seed=config["seed"], domain_rand=False, distortion=False, camera_width=16,
            camera_height=16, frame_rate=1.0 / STEP_S, max_steps=10**9, accept_start_angle_deg=180, num_tris_distractors=0,
        )  # fmt: skip
        self._views = {name: PygletView(lens, config["supersampling"]) for name, lens in cameras.items()}
        self._things = list(self._sim.objects)
        self._added: dict[tuple[str, str], Any] = {}
        self._model: Any = None

    def describe(self) -> Reply:
        """Closed ways ``[N, 2]`` along the lanes' middles, one after the other, and the half width of a lane [m]."""
        curves = [curve for tile in self._sim.drivable_tiles for curve in tile["curves"]]
        ways = _closed_ways(curves)
        tile_m = float(self._sim.road_tile_size)
        size_m = [self._sim.grid_width * tile_m, self._sim.grid_height * tile_m]
        facts = {
            "simulator": "duckietown-gym-daffy 6.1.34",
            "ways": [len(way) for way in ways],
            "tile_m": tile_m,
            "size_m": size_m,
        }
        return facts, {"ways": np.concatenate(ways) if ways else np.zeros((0, 2))}

    def render(self, camera: str, depth: bool, T_world_from_camera: np.ndarray) -> Reply:
        """A picture, and its depth if requested."""
        view, sim = self._views[camera], self._sim
        kept = sim.cur_pos, sim.cur_angle
        self._aim(T_world_from_camera, view)
        sim.objects = [*self._things, *self._added.values()]
        fine = sim._render_img(*view.size, view.drawn, view.resolved, view.pixels, top_down=False)
        sim.objects = self._things  # the robot does not collide with them
        found = {"rgb": view.mean(fine), "T_world_from_camera": taken_from()}
        if depth:
            found["depth"] = view.depth()
        sim.cur_pos, sim.cur_angle = kept
        return {}, found

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> Reply:
        """Put the robot down at rest; commands under way are forgotten."""
        self._pose, self._speed_mps, self._model = (
            (x_m, y_m, math.remainder(yaw_rad, 2.0 * math.pi)),
            0.0,
            None,
        )
        self._blocked = self._hits()
        return self._state()

    def step(self, control: float, speed_mps: float, duration_s: float) -> Reply:
        """Hold a turn rate [rad/s] and a speed [m/s]. A robot that was just put down starts at that speed: drives begin rolling."""
        if self._model is None:
            self._model = self._rolling(speed_mps)
        # What the nominal motors settle at, solved for their two voltages.
        dynamics = get_DB18_nominal(0.0)
        mean = speed_mps * dynamics.u1 / (2.0 * dynamics.u_alpha_r)
        apart = control * dynamics.w1 / (2.0 * dynamics.w_alpha_r)
        command = PWMCommands(motor_left=mean - apart, motor_right=mean + apart)
        for _ in range(max(round(duration_s / STEP_S), 1)):
            if self._blocked:
                self._speed_mps = 0.0
                break
            self._model = self._model.integrate(STEP_S, command)
            pose, velocity = self._model.TSE2_from_state()
            (x, y), yaw = geometry.translation_angle_from_SE2(pose)
            linear, _ = geometry.linear_angular_from_se2(velocity)
            self._pose, self._speed_mps = (float(x), float(y), float(yaw)), float(linear[0])
            self._blocked = self._hits()
        return self._state()

    def add_panel(self, name: str, size_m: list[float] | None, **arrays: np.ndarray) -> Reply:
        """Put a panel with ``T_world_from_face`` and texture ``rgb`` into the scene; without a size, remove it."""
        return self._add(("panel", name), None if size_m is None else PygletPanel(size_m, **arrays))

    def add_mesh(self, name: str, **arrays: np.ndarray) -> Reply:
        """Put triangles ``corners_m``, with ``normals``, ``uv`` and texture ``rgb``, into the scene; without them, take them out."""
        return self._add(("mesh", name), PygletMesh(**arrays) if arrays else None)

    def _add(self, name: tuple[str, str], thing: Any) -> Reply:
        """Put something into the scene in place of what has this name; None only takes that out."""
        if name in self._added:
            self._added.pop(name).delete()
        if thing is not None:
            self._added[name] = thing
        return {}, {}

    def _rolling(self, speed_mps: float) -> Any:
        """Duckietown's nominal robot with its delay, which has driven straight at this speed."""
        dynamics = get_DB18_nominal(0.0)
        voltage = speed_mps * dynamics.u1 / (2.0 * dynamics.u_alpha_r)
        x, y, yaw = self._pose
        begin = (
            geometry.SE2_from_translation_angle([x, y], yaw),
            geometry.se2_from_linear_angular([speed_mps, 0.0], 0.0),
        )
        return ApplyDelay(dynamics, DELAY_S, PWMCommands(voltage, voltage)).initialize(c0=begin, t0=0)

    def _aim(self, T: np.ndarray, view: PygletView) -> None:
        """Put Duckietown's camera at ``T_world_from_camera``: its robot turned and moved, its camera pitched."""
        forward, right = T[:3, 2], T[:3, 0]
        if abs(right[2]) > 1e-6:
            raise ValueError("expected a camera that is not rolled to a side: Duckietown's cannot be")
        yaw, pitch_down = (
            math.atan2(-right[0], right[1]) + math.pi,
            -math.asin(max(-1.0, min(1.0, forward[2]))),
        )
        ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        sim = self._sim
        sim.cam_fov_y, sim.cam_angle, sim.cam_height = (
            view.fov_y_deg,
            [math.degrees(pitch_down), 0.0, 0.0],
            0.0,
        )
        sim.cur_pos, sim.cur_angle = to_opengl(T[:3, 3] - CAMERA_FORWARD_DIST * ahead), yaw

    def _hits(self) -> bool:
        """Whether the robot touches one of the map's objects."""
        x, y, yaw = self._pose
        return bool(self._sim._collision(get_agent_corners(to_opengl(np.array([x, y, 0.0])), yaw)))

    def _state(self) -> Reply:
        return {"state": [*self._pose, self._speed_mps, 0.0], "blocked": self._blocked}, {}


def _closed_ways(curves: list[np.ndarray]) -> list[np.ndarray]:
    """Closed routes ``[N, 2]`` round the map: each curve is followed by the straightest one that begins at its end."""
    left, found = list(range(len(curves))), []
    while left:
        way = [left[0]]
        while (after := _next(curves, way[-1])) is not None and after not in way:
            way.append(after)
        left = [index for index in left if index not in way]
        if after == way[0]:
            found.append(np.concatenate([_points(curves[index]) for index in way]))
    return found


def _next(curves: list[np.ndarray], index: int) -> int | None:
    """The curve that continues from the end of one."""
    end, course = curves[index][3], curves[index][3] - curves[index][0]
    begins = [other for other, curve in enumerate(curves) if np.linalg.norm(curve[0] - end) < _JOINED_M]
    return max(begins, key=lambda other: float((curves[other][3] - curves[other][0]) @ course), default=None)


def _points(curve: np.ndarray) -> np.ndarray:
    """Points ``[N, 2]`` on a cubic Bezier curve without its end."""
    t = np.linspace(0.0, 1.0, _CURVE_POINTS, endpoint=False)[:, None]
    points = (
        (1 - t) ** 3 * curve[0]
        + 3 * t * (1 - t) ** 2 * curve[1]
        + 3 * t**2 * (1 - t) * curve[2]
        + t**3 * curve[3]
    )
    return np.column_stack([points[:, 0], -points[:, 2]])
