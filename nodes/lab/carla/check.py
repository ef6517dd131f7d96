"""Checks whether a CARLA server is fit for an experiment: one line per check, in the order of dependence."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from hardware.worlds.carla.camera import DEPTH, RGB, camera_blueprint
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.connection import check_nobody_else, connect, map_name
from hardware.worlds.carla.errors import CarlaError, CarlaFrameError, CarlaMapError
from hardware.worlds.carla.junction import find_drives
from hardware.worlds.carla.library import load_carla, server_answers
from hardware.worlds.carla.scene import CarlaScene
from hardware.worlds.world import require_depth
from nodes.runtime.findings import CheckFinding

_STEPS = 10
_GROUND_TOLERANCE = 0.03
_GROUND_SHARE = 0.5  # at least this share of the picture's lower middle must be road


def check_server(
    config: CarlaConfig, library: Any = None, pictures: Path | None = None
) -> list[CheckFinding]:
    """Check a server; stops at the first failure that prevents the rest.

    The map is not changed. If all checks pass a scene is opened for a few ticks and restored.

    Args:
        library: The ``carla`` module; None imports it.
        pictures: Folder for the driving camera's pictures, for a person to inspect.
    """
    checks: list[CheckFinding] = []

    def look(name: str, what: Callable[[], Any]) -> Any:
        """What a check finds, or None if it failed, which is recorded, as its findings are."""
        try:
            with server_answers(name):
                found = what()
        except CarlaError as error:
            checks.append(CheckFinding(name, "failure", str(error)))
            return None
        if isinstance(found, CheckFinding):
            checks.append(found)
        return found

    module = library if library is not None else look("client library", load_carla)
    if module is None:
        return checks
    client = look("server", lambda: connect(config.server, module))
    if client is None:
        return checks
    where = f"CARLA {client.get_server_version()} at {config.server.host}:{config.server.port}, as the client library"
    checks.append(CheckFinding("server", "ok", where))
    world = look("map", client.get_world)
    if world is None:
        return checks
    checks.append(_look_at_map(config, client, world))
    if checks[-1].state != "ok" or look("junction", lambda: _look_at_junction(config, world, module)) is None:
        return checks
    if look("world", lambda: _look_at_world(config, world)) is None:
        return checks
    look("blueprints", lambda: _look_at_blueprints(config, world))
    if all(check.met for check in checks):
        look("pictures", lambda: _look_at_pictures(config, module, pictures, checks))
        look("put back", lambda: _look_at_settings(world))
    return checks


def _look_at_map(config: CarlaConfig, client: Any, world: Any) -> CheckFinding:
    loaded, wanted = map_name(world.get_map().name), config.server.town
    if wanted in (None, loaded):
        return CheckFinding("map", "ok", loaded)
    if wanted not in {map_name(path) for path in client.get_available_maps()}:
        text = f"expected {wanted}, got {loaded}, and the server does not have {wanted}"
        return CheckFinding("map", "failure", text)
    if config.server.load_town:
        text = f"{loaded}; an experiment would load {wanted}. To look at that: ask with --set server.town={loaded}, or load it first"
        return CheckFinding("map", "warning", text)
    return CheckFinding("map", "failure", f"expected {wanted}, got {loaded}, and server.load_town is off")


def _look_at_junction(config: CarlaConfig, world: Any, library: Any) -> CheckFinding:
    drives = find_drives(world.get_map(), library, config.junction)
    lengths = ", ".join(f"{name} {path.length_m:.1f} m" for name, path in drives.paths.items())
    side = "right" if drives.right_hand else "left"
    text = (
        f"{drives.junction_id}: {lengths}; lanes {drives.lane_width_m:.2f} m, traffic on the {side}, heights within "
        f"{drives.height_range_m:.2f} m"
    )
    return CheckFinding("junction", "ok" if drives.right_hand else "warning", text)


def _look_at_world(config: CarlaConfig, world: Any) -> CheckFinding:
    check_nobody_else(world, config.server)
    return CheckFinding("world", "ok", "nobody else drives it or is in it")


def _look_at_blueprints(config: CarlaConfig, world: Any) -> CheckFinding:
    for kind in (RGB, DEPTH):
        camera_blueprint(world, kind, config.camera.pinhole, config.render)
    vehicle = config.body.blueprint
    if vehicle is not None:
        try:
            world.get_blueprint_library().find(vehicle)
        except IndexError as error:
            raise CarlaMapError(f"expected the vehicle {vehicle} (body.blueprint), got: {error}") from error
    return CheckFinding("blueprints", "ok", f"{RGB}, {DEPTH}, {vehicle or 'no vehicle'}, with all attributes")


def _look_at_pictures(
    config: CarlaConfig, library: Any, folder: Path | None, checks: list[CheckFinding]
) -> None:
    with CarlaScene(config, library) as scene:
        scene.reset(*scene.paths["straight"].start_pose)
        rgb, depth = require_depth(scene.observe())
        began = time.monotonic()
        for _ in range(_STEPS):
            scene.step(0.0, config.car.speed_mps, config.render.fixed_delta_s)
            rgb, depth = require_depth(scene.observe())
        seconds, repeated = (time.monotonic() - began) / _STEPS, scene.repeated_frames
        text = f"frame numbers and poses as asked, {1e3 * seconds:.0f} ms for a step and its picture"
        if repeated:
            text += f"; {repeated} of {_STEPS + 1} pictures had to be asked for again, which costs time and nothing else"
        checks.append(CheckFinding("pictures", "warning" if repeated else "ok", text))
        if folder is not None:
            _write(folder, rgb, depth)
        checks.append(_ground(scene.camera_pinhole, scene.T_car_from_camera, rgb, depth))


def _ground(
    pinhole: Pinhole, T_car_from_camera: Any, rgb: NDArray[np.uint8], depth: NDArray[np.float32]
) -> CheckFinding:
    """Check that the road is where depth says, for a camera mounted as ours. Wrong units, a wrong angle or a bonnet in view show here."""
    rows, columns = slice(int(0.75 * pinhole.height), None), slice(pinhole.width // 3, 2 * pinhole.width // 3)
    down = -(pinhole.directions()[rows, columns] @ T_car_from_camera[:3, :3].T)[..., 2]
    expected = T_car_from_camera[2, 3] / down
    ratio = depth[rows, columns] / expected
    share = float(np.mean(np.abs(ratio - 1.0) < _GROUND_TOLERANCE))
    text = f"{100 * share:.0f} % of the lower middle of the picture is road at the expected depth"
    if float(rgb.std()) < 1.0:
        text += ", but the picture is of one colour: does the server render? (-RenderOffScreen)"
        return CheckFinding("picture", "failure", text)
    if share >= _GROUND_SHARE:
        return CheckFinding("depth", "ok", text)
    text += (
        f"; depth there is {float(np.median(ratio)):.2f} of what a flat road gives. Does the camera see the car itself, is the ground at the "
        "height of the map's lanes, is the camera higher than they say? Look at the pictures (-o)"
    )
    return CheckFinding("depth", "failure", text)


def _look_at_settings(world: Any) -> CheckFinding:
    settings = world.get_settings()
    if settings.synchronous_mode:
        raise CarlaFrameError(
            "expected the world to tick by itself again, it does not: `advnerf scene carla release`"
        )
    return CheckFinding("put back", "ok", "the world ticks by itself again")


def _write(folder: Path, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> None:
    near = 255.0 * np.clip(2.0 / np.maximum(depth, 2.0), 0.0, 1.0)
    for name, image in (
        ("colour.png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)),
        ("depth.png", near.astype(np.uint8)),
    ):
        write_atomically(folder / name, cv2.imencode(".png", image)[1].tobytes())
