"""A CARLA server that follows a script: it keeps the books, draws a small world, and misbehaves when told to.

Geometry, maps, settings and weather are those of the real client library; only what would go over the network is played. The world is
drawn in CARLA's own left-handed axes with the library's own matrices, so that what our side makes of it is checked against them.
"""

from __future__ import annotations

import fnmatch
import math
import threading
from types import SimpleNamespace

import numpy as np

COMMON = {"image_size_x": "800", "image_size_y": "600", "fov": "90.0", "sensor_tick": "0.0", "lens_k": "-1.0"}
POST = {
    "motion_blur_intensity": "0.45", "lens_flare_intensity": "0.1", "bloom_intensity": "0.675", "exposure_mode": "histogram",
    "exposure_min_bright": "10.0", "exposure_max_bright": "12.0",
}  # fmt: skip
BLUEPRINTS = {
    "sensor.camera.rgb": {**COMMON, **POST},
    "sensor.camera.depth": COMMON,
    "vehicle.lincoln.mkz_2020": {"color": "0,0,0"},
}
TIMEOUT = "time-out of 20000ms while waiting for the simulator, make sure the simulator is ready and connected to 127.0.0.1:2000"


class Blueprint:
    def __init__(self, kind):
        self.id, self.values = kind, dict(BLUEPRINTS[kind])

    def has_attribute(self, name):
        return name in self.values

    def get_attribute(self, name):
        return SimpleNamespace(as_float=lambda: float(self.values[name]))

    def set_attribute(self, name, value):
        assert isinstance(value, str), "the library takes text only"
        self.values[name] = value


class Actor:
    def __init__(self, world, blueprint, transform):
        self.world, self.type_id, self.values = world, blueprint.id, dict(blueprint.values)
        self.transform, self.wanted, self.callback, self.physics, self.alive = (
            transform,
            None,
            None,
            True,
            True,
        )

    def set_transform(self, transform):
        self.world.answer("set_transform")
        assert self.alive, "a removed actor was moved"
        self.wanted = transform

    def set_simulate_physics(self, on):
        self.physics = on

    def listen(self, callback):
        self.callback = callback

    def stop(self):
        self.world.answer("stop")
        self.callback = None

    def destroy(self):
        self.world.answer("destroy")
        assert self.callback is None, "a camera that is listened to was removed"
        self.alive = False
        self.world.actors.remove(self)


class Actors(list):
    def filter(self, pattern):
        return [actor for actor in self if fnmatch.fnmatch(actor.type_id, pattern)]


class World:
    """Attributes: script: what happens at which tick (1 is the first): "drop", "late", "hang" or "die". late_poses: every
    ``set_transform`` takes effect one tick too late. walls: ((x, y), (x, y), label) in CARLA's axes.
    """

    def __init__(self, library, carla_map, ground_m=0.0):
        self.library, self.map, self.ground_m = library, carla_map, ground_m
        self.settings, self.weather, self.lights_frozen = (
            library.WorldSettings(),
            library.WeatherParameters(),
            False,
        )
        self.actors, self.walls, self.calls, self.script = Actors(), [], [], {}
        self.frame, self.ticks, self.late_poses, self.dead, self.threads = 4000, 0, False, False, []

    def answer(self, what):
        if self.dead:
            raise RuntimeError(TIMEOUT)
        self.calls.append(what)

    def get_map(self):
        return self.map

    def get_settings(self):
        self.answer("get_settings")
        return self._copy(self.settings)

    def apply_settings(self, settings):
        self.answer("apply_settings")
        self.settings = self._copy(settings)
        return self.frame

    def _copy(self, settings):
        names = (
            "synchronous_mode",
            "no_rendering_mode",
            "substepping",
            "max_substep_delta_time",
            "max_substeps",
        )
        copy = self.library.WorldSettings(**{name: getattr(settings, name) for name in names})
        copy.fixed_delta_seconds = settings.fixed_delta_seconds
        return copy

    def get_weather(self):
        return self.weather

    def set_weather(self, weather):
        self.answer("set_weather")
        self.weather = weather

    def freeze_all_traffic_lights(self, frozen):
        self.answer("freeze")
        self.lights_frozen = frozen

    def get_actors(self):
        return self.actors

    def get_blueprint_library(self):
        def find(kind):
            if kind not in BLUEPRINTS:
                raise IndexError(f"blueprint '{kind}' not found")
            return Blueprint(kind)

        return SimpleNamespace(find=find)

    def spawn_actor(self, blueprint, transform):
        self.answer(f"spawn {blueprint.id}")
        if blueprint.id.startswith("vehicle") and transform.location.z < self.ground_m + 10.0:
            raise RuntimeError("Spawn failed because of collision at spawn position")
        self.actors.append(Actor(self, blueprint, transform))
        return self.actors[-1]

    def cast_ray(self, start, end):
        self.answer("cast_ray")
        hits = [SimpleNamespace(label=self.library.CityObjectLabel.Roads, location=end)]
        for one, other, label in self.walls:
            (ax, ay), (bx, by) = one, other
            dx, dy, ex, ey = end.x - start.x, end.y - start.y, bx - ax, by - ay
            cross = dx * ey - dy * ex
            if abs(cross) > 1e-9:
                s = ((ax - start.x) * ey - (ay - start.y) * ex) / cross
                t = ((ax - start.x) * dy - (ay - start.y) * dx) / cross
                if 0 <= s <= 1 and 0 <= t <= 1:
                    hits.append(SimpleNamespace(label=label, location=end))
        return hits

    def tick(self, seconds):
        assert self.settings.synchronous_mode, "ticked a world that is not synchronous"
        assert seconds > 0, "a tick without a time-out may hang for ever"
        self.ticks += 1
        what = self.script.get(self.ticks)
        if what == "die":
            self.dead = True
        if what in ("die", "hang"):
            raise RuntimeError(TIMEOUT)
        self.answer("tick")
        self.frame += 1
        pictures = []
        for actor in self.actors:
            if not self.late_poses and actor.wanted is not None:
                actor.transform, actor.wanted = actor.wanted, None
            if actor.callback is not None and what != "drop":
                pictures.append((actor.callback, self.picture(actor)))
            if self.late_poses and actor.wanted is not None:
                actor.transform, actor.wanted = actor.wanted, None
        if what == "late":
            self.threads.append(
                threading.Timer(0.05, lambda: [callback(picture) for callback, picture in pictures])
            )
            self.threads[-1].start()
        else:
            for callback, picture in pictures:
                callback(picture)
        return self.frame

    def picture(self, actor):
        width, height = int(actor.values["image_size_x"]), int(actor.values["image_size_y"])
        points, depth = self.see(actor.transform, width, height, float(actor.values["fov"]))
        if actor.type_id == "sensor.camera.depth":
            steps = np.rint(np.minimum(depth / 1000.0, 1.0) * (256**3 - 1)).astype(np.int64)
            bgr = np.stack([steps >> 16 & 255, steps >> 8 & 255, steps & 255], -1)
        else:
            bgr = self.colour(points)[..., ::-1]
        bgra = np.concatenate([bgr, np.full((height, width, 1), 255)], -1).astype(np.uint8)
        return SimpleNamespace(
            frame=self.frame,
            transform=actor.transform,
            width=width,
            height=height,
            fov=float(actor.values["fov"]),
            raw_data=bgra.tobytes(),
        )

    def colour(self, points):
        """Where a point is, as a colour: two counts of red and green per metre from the map's origin, 50 of blue upwards."""
        x, y, z = (np.nan_to_num(points[..., i]) for i in range(3))
        return np.clip(np.rint(np.stack([128 + 2 * x, 128 + 2 * y, 50 * (z - self.ground_m)], -1)), 0, 255)

    def see(self, transform, width, height, fov_deg):
        """Points in CARLA's axes and planar depth, per pixel; ground and walls, nothing else (NaN, 1000 m)."""
        T = np.array(transform.get_matrix())
        focal = 0.5 * width / math.tan(math.radians(0.5 * fov_deg))
        right, down = np.meshgrid(
            (np.arange(width) + 0.5 - 0.5 * width) / focal, (np.arange(height) + 0.5 - 0.5 * height) / focal
        )
        rays = np.stack([np.ones_like(right), right, -down], -1) @ T[:3, :3].T
        eye = T[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (self.ground_m - eye[2]) / rays[..., 2]
            best = np.where(t > 0.05, t, np.inf)
            for (ax, ay), (bx, by), _ in self.walls:
                normal = np.array([by - ay, ax - bx])
                t = normal @ (np.array([ax, ay]) - eye[:2]) / (rays[..., :2] @ normal)
                at = eye[:2] + t[..., None] * rays[..., :2]
                along = ((at - [ax, ay]) @ [bx - ax, by - ay]) / ((bx - ax) ** 2 + (by - ay) ** 2)
                top = eye[2] + t * rays[..., 2] < self.ground_m + 4.0
                best = np.where((t > 0.05) & (along >= 0) & (along <= 1) & top & (t < best), t, best)
            points = np.where(np.isfinite(best)[..., None], eye + best[..., None] * rays, np.nan)
        return points, np.minimum(best, 1000.0)


class Library:
    """The real module with another ``Client``."""

    def __init__(self, carla, world, maps=("/Game/Carla/Maps/written",)):
        self._carla, self.world, self.maps, self.clients = carla, world, list(maps), []
        self.server_version = self.client_version = "0.9.16"

    def __getattr__(self, name):
        return getattr(self._carla, name)

    def Client(self, host, port):
        self.clients.append(Client(self))
        return self.clients[-1]


class Client:
    def __init__(self, library):
        self._library, self.timeout_s, self.loaded = library, 5.0, []

    def set_timeout(self, seconds):
        self.timeout_s = seconds

    def get_client_version(self):
        return self._library.client_version

    def get_server_version(self):
        return self._library.server_version

    def get_world(self):
        return self._library.world

    def get_available_maps(self):
        return self._library.maps

    def load_world(self, name):
        self.loaded.append((name, self.timeout_s))
        return self._library.world
