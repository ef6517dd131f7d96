"""MetaDrive 0.3.0.1 for ``serve.py``: a road by block string and seed, our own camera, and a Bullet vehicle under a controller.

It imports nothing of advnerf. Its axes are Panda3D's, z up; MetaDrive's own y and heading have the other sign.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from panda3d.core import loadPrcFileData

loadPrcFileData("", "load-display p3headlessgl\naudio-library-name null\nnotify-level-egldisplay error")

from metadrive.component.map.pg_map import MapGenerateMethod  # noqa: E402 - the display is chosen before the import
from metadrive.constants import BodyName, CamMask  # noqa: E402
from metadrive.engine.core.our_pbr import OurPipeline  # noqa: E402
from metadrive.envs.metadrive_env import MetaDriveEnv  # noqa: E402
from panda3d.core import LQuaternionf, Vec3  # noqa: E402
from panda_camera import PandaView, mesh_node, panel_card  # noqa: E402

# Software rendering has no 16 samples per pixel for the pass before the tone curve; our cameras average pixels and apply that curve to the mean.
loadPrcFileData("", "framebuffer-multisample 0\nmultisamples 0\nload-display p3headlessgl")
OurPipeline._setup_tonemapping = lambda self: None

PHYSICS_S, TRAFFIC_STEPS = 0.02, 5
_SETTLING_S, _SPACING_M, _CLEAR_M = 4.0, 1.0, 15.0
# Force per wheel [N] and brake for an error of speed of 1 m/s; the vehicle's own limits hold.
_FORCE_PER_MPS, _BRAKE_PER_MPS = 1600.0, 40.0
Reply = tuple[dict[str, Any], dict[str, np.ndarray]]


class Simulator:
    """One MetaDrive engine; see docs/worlds.md for the calls."""

    def __init__(self, config: dict[str, Any], cameras: dict[str, Any]) -> None:
        self._config = config
        road = config["road"]
        self._env = MetaDriveEnv(
            {
                "use_render": False, "image_observation": True, "multi_thread_render": False, "disable_model_compression": True,
                "interface_panel": [], "window_size": (16, 16), "show_skybox": config["sky"], "show_terrain": config["terrain"],
                "start_seed": road["seed"], "random_spawn_lane_index": False,
                "map_config": {"type": MapGenerateMethod.BIG_BLOCK_SEQUENCE, "config": road["blocks"], "lane_width": road["lane_width_m"], "lane_num": road["lanes"]},
                "traffic_density": config["traffic_density"], "traffic_mode": "respawn", "force_destroy": True,
                "vehicle_config": {"image_source": "main_camera", "vehicle_model": config["car"]["model"], "show_navi_mark": False},
            }
        )  # fmt: skip
        np.random.seed(road["seed"])  # noqa: NPY002 - MetaDrive draws heights of its lanes and pavements from it
        self._env.reset()
        self._engine = self._env.engine
        fine, mask = config["supersampling"], CamMask.RgbCam
        self._views = {
            name: PandaView(self._engine, name, lens, fine, mask) for name, lens in cameras.items()
        }
        for window in self._engine.graphicsEngine.getWindows():
            window.setActive(False)
        self._engine.world_light.direction_np.node().setShadowCaster(False)
        self._added: dict[str, Any] = {}
        self._prepare()
        self._wheelbase_m = float(self._vehicle.FRONT_WHEELBASE + self._vehicle.REAR_WHEELBASE)
        self._physics = self._engine.physics_world.dynamic_world
        self._height_m = self._settled()

    def describe(self) -> Reply:
        """Wheelbase [m], the route's lane as poses ``[N, 3]``, and the middles and edges of all lanes, one after the other ``[N, 2]``."""
        network = self._engine.current_map.road_network
        route: list[tuple[float, float, float]] = []
        for start, end in pairwise(self._vehicle.navigation.checkpoints):
            lanes = network.graph[start][end]
            wanted = lanes[min(self._config["road"]["lane"], len(lanes) - 1)]
            lane = _nearest(lanes, route[-1]) if route else wanted
            route += [_pose(lane, s) for s in np.arange(0.0, lane.length - 0.5 * _SPACING_M, _SPACING_M)]
        middles, edges = [], []
        for lanes in (lanes for ends in network.graph.values() for lanes in ends.values()):
            middles += [_line(lane, 0.0) for lane in lanes]
            sides = ((lanes[0], -0.5), (lanes[-1], 0.5))
            edges += [_line(lane, share * lane.width_at(0.0)) for lane, share in sides]
        facts = {
            "middles": [*map(len, middles)],
            "edges": [*map(len, edges)],
            "simulator": "MetaDrive 0.3.0.1",
        }
        lines = {"middles": np.concatenate(middles), "edges": np.concatenate(edges)}
        return {"wheelbase_m": self._wheelbase_m, **facts}, {"route": np.array(route), **lines}

    def render(self, camera: str, depth: bool, T_world_from_camera: np.ndarray) -> Reply:
        """A picture, and its depth if requested; photographs show no traffic."""
        view, hidden = (
            self._views[camera],
            self._engine.traffic_manager.traffic_vehicles if camera == "photo" else [],
        )
        taken = view.aim(T_world_from_camera)
        view.buffer.setActive(True)
        for other in hidden:
            other.origin.hide()
        self._engine.graphicsEngine.renderFrame()
        for other in hidden:
            other.origin.show()
        view.buffer.setActive(False)
        found = {"rgb": view.picture(), "T_world_from_camera": taken}
        if depth:
            found["depth"] = view.depth()
        return {}, found

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> Reply:
        """Put the vehicle down, at rest on its springs; the traffic restarts."""
        self._pose, self._speed_mps = (x_m, y_m, math.remainder(yaw_rad, 2.0 * math.pi)), 0.0
        if self._config["traffic_density"]:
            self._restart_traffic()
        self._time_steps, self._rolls = 0, False
        self._put(self._height_m, 0.0)
        return self._state(0.0)

    def step(self, control: float, speed_mps: float, duration_s: float) -> Reply:
        """Hold a wheel angle [rad] and a speed [m/s]. A vehicle that was just put down starts at that speed: drives begin rolling."""
        limit = self._config["car"]["max_wheel_rad"]
        wheel_rad = min(max(control, -limit), limit)
        if not self._rolls and speed_mps:
            self._rolls = True
            self._put(self._height_m, speed_mps)
        for _ in range(max(round(duration_s / PHYSICS_S), 1)):
            (self._hold if self._config["car"]["own"] else self._follow)(wheel_rad, speed_mps)
            if self._config["traffic_density"]:
                self._move_traffic()
            self._physics.doPhysics(PHYSICS_S, 1, PHYSICS_S)
            self._time_steps += 1
            self._read()
        return self._state(wheel_rad)

    def add_panel(self, name: str, size_m: list[float] | None, **arrays: np.ndarray) -> Reply:
        """Put a card with ``T_world_from_face`` and texture ``rgb`` into the scene; without a size, remove it."""
        return self._add(f"panel {name}", None if size_m is None else panel_card(name, size_m, **arrays))

    def add_mesh(self, name: str, **arrays: np.ndarray) -> Reply:
        """Put triangles ``corners_m``, with ``normals``, ``uv`` and texture ``rgb``, into the scene; without them, take them out."""
        return self._add(f"mesh {name}", mesh_node(name, **arrays) if arrays else None)

    def _add(self, name: str, node: Any) -> Reply:
        """Put a node into the scene in place of the one of this name; None only takes that out."""
        if name in self._added:
            self._added.pop(name).removeNode()
        if node is not None:
            self._added[name] = node
            node.reparentTo(self._engine.render)
        return {}, {}

    def _put(self, height_m: float, speed_mps: float) -> None:
        """Place the vehicle at its pose without memory of earlier motion."""
        x, y, yaw = self._pose
        vehicle, turn, back = self._vehicle, yaw - 0.5 * math.pi, self._vehicle.REAR_WHEELBASE
        c, s = math.cos(yaw), math.sin(yaw)
        vehicle.body.clearForces()
        vehicle.origin.setPos(x + back * c, y + back * s, height_m)
        vehicle.origin.setQuat(LQuaternionf(math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn)))
        vehicle.body.setLinearVelocity(Vec3(speed_mps * c, speed_mps * s, 0.0))
        vehicle.body.setAngularVelocity(Vec3(0.0, 0.0, 0.0))
        vehicle.system.resetSuspension()
        for index, wheel in enumerate(vehicle.system.getWheels()):
            wheel.setRotation(0.0)
            vehicle.system.setSteeringValue(0.0, index)
            vehicle.system.applyEngineForce(0.0, index)
            vehicle.system.setBrake(0.0, index)

    def _hold(self, wheel_rad: float, speed_mps: float) -> None:
        """Speed and steering controller of the Bullet vehicle."""
        vehicle, limits = self._vehicle, self._vehicle.config
        error = speed_mps - self._speed_mps
        force = min(max(_FORCE_PER_MPS * error, 0.0), limits["max_engine_force"])
        brake = min(max(-_BRAKE_PER_MPS * error, 0.0), limits["max_brake_force"])
        for index in range(4):
            vehicle.system.applyEngineForce(force, index)
            vehicle.system.setBrake(brake, index)
            vehicle.system.setSteeringValue(math.degrees(wheel_rad) if index < 2 else 0.0, index)

    def _follow(self, wheel_rad: float, speed_mps: float) -> None:
        """The ideal car: a kinematic bicycle, exact over each physics step; the Bullet body goes with it, for traffic to see."""
        way_m = speed_mps * PHYSICS_S
        half = (
            0.5 * way_m * math.tan(wheel_rad) / self._wheelbase_m
        )  # of the turn; a chord points half-way through it
        chord, (x, y, yaw) = way_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0), self._pose
        x, y = x + chord * math.cos(yaw + half), y + chord * math.sin(yaw + half)
        self._pose, self._speed_mps = (x, y, math.remainder(yaw + 2.0 * half, 2.0 * math.pi)), speed_mps
        self._put(self._height_m, speed_mps)

    def _read(self) -> None:
        """Read the pose of the Bullet vehicle's rear axle."""
        if not self._config["car"]["own"]:
            return
        forward, at = self._vehicle.system.getForwardVector(), self._vehicle.origin.getPos()
        yaw, back = math.atan2(forward[1], forward[0]), self._vehicle.REAR_WHEELBASE
        self._pose = at[0] - back * math.cos(yaw), at[1] - back * math.sin(yaw), yaw
        velocity = self._vehicle.body.getLinearVelocity()
        self._speed_mps = velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw)

    def _state(self, wheel_rad: float) -> Reply:
        return {"state": [*self._pose, self._speed_mps, wheel_rad], "blocked": self._touches()}, {}

    def _touches(self) -> bool:
        """Whether the vehicle's body touches another one, such as the traffic's."""
        found = self._physics.contactTest(self._vehicle.body, True).getContacts()
        return any(
            each.getNode0().getName() == each.getNode1().getName() == BodyName.Vehicle for each in found
        )

    def _settled(self) -> float:
        """Height of the vehicle's origin when it stands on its springs [m]."""
        at, forward = self._vehicle.origin.getPos(), self._vehicle.system.getForwardVector()
        self._pose, self._speed_mps = (at[0], at[1], math.atan2(forward[1], forward[0])), 0.0
        self._put(at[2], 0.0)
        for _ in range(round(_SETTLING_S / PHYSICS_S)):
            self._physics.doPhysics(PHYSICS_S, 1, PHYSICS_S)
        return float(self._vehicle.origin.getZ())

    def _prepare(self) -> None:
        """Repeat what MetaDrive's reset recreates: its vehicle, which no camera sees, the light, and textures."""
        self._vehicle = self._env.vehicle
        self._vehicle.origin.hide(CamMask.RgbCam)
        self._engine.world_light.step((0.0, 0.0))
        for texture in [] if self._config["anisotropic"] else self._engine.render.findAllTextures():
            texture.setAnisotropicDegree(1)

    def _restart_traffic(self) -> None:
        """Restore MetaDrive's traffic to its initial state, without vehicles at the car's pose."""
        self._env.reset(force_seed=self._config["road"]["seed"])
        self._prepare()
        manager, x, y = self._engine.traffic_manager, *self._pose[:2]
        near = [each for each in manager.traffic_vehicles if math.dist(each.position, (x, -y)) < _CLEAR_M]
        manager._traffic_vehicles = [each for each in manager.traffic_vehicles if each not in near]
        manager.clear_objects([each.id for each in near])

    def _move_traffic(self) -> None:
        """Let the traffic decide, ten times a second."""
        if self._time_steps % TRAFFIC_STEPS == 0:
            if self._time_steps:
                self._engine.traffic_manager.after_step()
            self._engine.traffic_manager.before_step()


def _nearest(lanes: list[Any], pose: tuple[float, float, float]) -> Any:
    """The lane that begins nearest to a pose."""
    return min(lanes, key=lambda lane: math.dist(_pose(lane, 0.0)[:2], pose[:2]))


def _pose(lane: Any, along_m: float) -> tuple[float, float, float]:
    at = lane.position(along_m, 0.0)
    return float(at[0]), -float(at[1]), -float(lane.heading_theta_at(along_m))


def _line(lane: Any, aside_m: float) -> np.ndarray:
    """Points ``[N, 2]`` along a lane, to the right of its middle."""
    count = max(round(lane.length / _SPACING_M), 2)
    points = [lane.position(s, aside_m) for s in np.linspace(0.0, lane.length, count + 1)]
    return np.array([(float(x), -float(y)) for x, y in points])


open_simulator = Simulator
