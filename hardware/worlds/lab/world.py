"""The room as a MuJoCo model, built in memory: surfaces with baked light, furniture, tape, board, monitor and the car."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from advnerf_core.geometry import Array, quaternion_from_rotation, rotation_z
from hardware.worlds.lab import textures
from hardware.worlds.lab.config import LabConfig, PanelConfig
from hardware.worlds.lab.furniture import Solid, furnish
from hardware.worlds.lab.gl import load_mujoco
from hardware.worlds.lab.surfaces import UP, Surface, paint_room
from hardware.worlds.lab.textures import Image
from hardware.worlds.world import Panel, Rgb

BOARD_PIXELS = (512, 512)  # width, height of the board face's texture
MONITOR_PIXELS = (1024, 576)
CAR_GROUP, CEILING_GROUP = 3, 2  # geom groups that views switch on or off
TAPE_HEIGHT_M = 0.001
# The lights that shade the furniture; the surfaces with baked light are corrected for them (see _add_surface).
AMBIENT = 0.62
LIGHTS = (((0.30, 0.18, -0.94), 0.44), ((-0.82, 0.45, -0.35), 0.16), ((0.55, -0.80, -0.25), 0.12))


def build_model(config: LabConfig, stood: Mapping[str, tuple[Panel, Rgb]] = MappingProxyType({})) -> Any:
    """Compile the room.

    The body "car" is a mocap body whose frame is the car's. The textures "board" and "monitor", and the textures of added panels,
    can be replaced while it runs (``Renderer.set_texture``).

    Args:
        stood: Additional panels, each with its texture ``[h, w, 3]``, by the texture's name. The furniture's
            lights shade them.

    Returns:
        A ``mujoco.MjModel``.
    """
    mujoco, spec = load_mujoco(), compose_room(config)
    for name, (panel, rgb) in stood.items():
        add_texture(mujoco, spec, name, rgb)
        add_material(mujoco, spec, name)
        _add_rectangle(mujoco, spec, name, panel.T_world_from_face, panel.width_m, panel.height_m)
    return spec.compile()


def compose_room(config: LabConfig) -> Any:
    """The room of `build_model` as a ``mujoco.MjSpec`` that is not compiled yet."""
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = 0
    # The renderer averages a larger image instead, which also filters textures.
    spec.visual.quality.offsamples = 0
    _add_lights(mujoco, spec)
    surfaces, tape = paint_room(config)
    for name, surface in surfaces.items():
        geom = _add_surface(mujoco, spec, surface)
        geom.group = CEILING_GROUP if name == "ceiling" else 0
    _add_tape(mujoco, spec, config, tape)
    for solid in furnish(config):
        _add_solid(mujoco, spec.worldbody, solid)
    _add_panel(
        mujoco, spec, "board", config.board, BOARD_PIXELS, np.full((8, 8, 3), config.board.rgb, np.float32)
    )
    _add_panel(
        mujoco, spec, "monitor", config.monitor, MONITOR_PIXELS, textures.screen_image(*MONITOR_PIXELS)
    )
    _add_car(mujoco, spec, config)
    return spec


def _add_lights(mujoco: Any, spec: Any) -> None:
    for index, (direction, strength) in enumerate(LIGHTS):
        light = spec.worldbody.add_light()
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.dir = direction
        light.diffuse = [strength] * 3
        light.ambient = [AMBIENT if index == 0 else 0.0] * 3
        light.specular = [0.0] * 3
        light.castshadow = False


def shading(normal: Array) -> float:
    """Factor by which the rasteriser multiplies a matte surface's colour."""
    total = AMBIENT
    for direction, strength in LIGHTS:
        total += strength * max(-float(np.dot(normal, direction)) / math.hypot(*direction), 0.0)
    return total


def _add_surface(mujoco: Any, spec: Any, surface: Surface) -> Any:
    """Add a one-sided rectangle whose picture is seen unchanged, independent of the rasteriser's lights."""
    factor = shading(surface.normal)
    add_texture(mujoco, spec, surface.name, textures.to_uint8(surface.image / np.float32(max(factor, 1.0))))
    material = add_material(mujoco, spec, surface.name)
    material.emission = max(1.0 - factor, 0.0)
    geom = add_geom(spec.worldbody, mujoco.mjtGeom.mjGEOM_PLANE, (*surface.half_m, 0.1))
    geom.pos = surface.centre_m
    geom.quat = wxyz(np.stack([surface.right, surface.up, surface.normal], axis=1))
    geom.material = surface.name
    return geom


def wxyz(rotation: Array) -> list[float]:
    """A rotation as a quaternion in MuJoCo's order w, x, y, z."""
    x, y, z, w = quaternion_from_rotation(rotation)
    return [w, x, y, z]


def add_texture(mujoco: Any, spec: Any, name: str, rgb: textures.Rgb) -> None:
    """Add a 2D texture of a picture ``[h, w, 3]``."""
    texture = spec.add_texture()
    texture.name = name
    texture.type = mujoco.mjtTexture.mjTEXTURE_2D
    texture.height, texture.width, texture.nchannel = rgb.shape
    texture.data = np.ascontiguousarray(rgb).tobytes()


def add_material(mujoco: Any, spec: Any, name: str) -> Any:
    """Add a matte material with the texture of the same name."""
    material = spec.add_material()
    material.name = name
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    material.specular = material.shininess = material.reflectance = 0.0
    return material


def add_geom(body: Any, kind: Any, size: tuple[float, ...]) -> Any:
    """Add a geom that is only drawn."""
    geom = body.add_geom()
    geom.type = kind
    geom.size = size
    geom.contype = geom.conaffinity = 0  # nothing here is simulated by MuJoCo: TwinVehicle moves the car
    return geom


def _add_solid(mujoco: Any, body: Any, solid: Solid) -> Any:
    kinds = {"box": "mjGEOM_BOX", "cylinder": "mjGEOM_CYLINDER", "ellipsoid": "mjGEOM_ELLIPSOID"}
    x, y, z = solid.half_m
    size = (x, z, 0.0) if solid.kind == "cylinder" else (x, y, z)
    geom = add_geom(body, getattr(mujoco.mjtGeom, kinds[solid.kind]), size)
    geom.pos = solid.centre_m
    geom.quat = [math.cos(0.5 * solid.yaw_rad), 0.0, 0.0, math.sin(0.5 * solid.yaw_rad)]
    geom.rgba = [*solid.rgb, 1.0]
    return geom


def _add_panel(
    mujoco: Any, spec: Any, name: str, panel: PanelConfig, pixels: tuple[int, int], image: Image
) -> None:
    T = panel.T_world_from_face
    full = textures.fit(textures.to_uint8(image), *pixels)
    add_texture(mujoco, spec, name, full)
    material = add_material(mujoco, spec, name)
    material.emission = max(1.0 - shading(T[:3, 0]), 0.0)
    _add_rectangle(mujoco, spec, name, T, panel.width_m, panel.height_m)


def _add_rectangle(
    mujoco: Any, spec: Any, name: str, T_world_from_face: Array, width_m: float, height_m: float
) -> None:
    """Add a one-sided rectangle with the named material."""
    geom = add_geom(spec.worldbody, mujoco.mjtGeom.mjGEOM_PLANE, (0.5 * width_m, 0.5 * height_m, 0.1))
    geom.pos = T_world_from_face[:3, 3]
    # A MuJoCo plane faces its z; its x is to the viewer's right, which is the panel's +y.
    geom.quat = wxyz(T_world_from_face[:3, [1, 2, 0]])
    geom.material = name


def _add_tape(mujoco: Any, spec: Any, config: LabConfig, picture: Image) -> None:
    """The tape as a flat ring of triangles: a texture would blur it at the grazing angle of the driving camera."""
    add_texture(mujoco, spec, "tape", textures.to_uint8(picture))
    material = add_material(mujoco, spec, "tape")
    material.emission = max(1.0 - shading(UP), 0.0)
    inner, outer = tape_edges(config)
    count = len(inner)
    flat = np.concatenate([inner, outer])
    vertices = np.concatenate(
        [np.c_[flat, np.full(2 * count, TAPE_HEIGHT_M)], np.c_[flat, np.zeros(2 * count)]]
    )
    i = np.arange(count)
    j = (i + 1) % count
    top = [np.c_[i, i + count, j + count], np.c_[i, j + count, j]]
    below = [np.c_[i, j + count, i + count] + 2 * count, np.c_[i, j, j + count] + 2 * count]
    mesh = spec.add_mesh()
    mesh.name = "tape"
    mesh.uservert = vertices.ravel().tolist()
    mesh.userface = np.concatenate(top + below).ravel().tolist()
    uv = vertices[:, :2] / config.room.side_m + 0.5
    mesh.usertexcoord = uv.ravel().tolist()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    geom = add_geom(spec.worldbody, mujoco.mjtGeom.mjGEOM_MESH, (0.0, 0.0, 0.0))
    geom.meshname = "tape"
    geom.material = "tape"


def tape_edges(config: LabConfig) -> tuple[Array, Array]:
    """Inner and outer edge of the tape, ``[N, 2]`` each [m], counter-clockwise, points across from each other."""
    track = config.track
    straight, steps = 0.5 * track.side_m - track.corner_radius_m, 24
    inner: list[Array] = []
    outer: list[Array] = []
    for corner in range(4):
        turn = rotation_z(0.5 * math.pi * corner)[:2, :2]
        for angle in np.linspace(-0.5 * math.pi, 0.0, steps + 1):
            direction = np.array([math.cos(angle), math.sin(angle)])
            centre = np.array([straight, -straight])
            for edge, side in ((inner, -0.5), (outer, 0.5)):
                radius = track.corner_radius_m + side * track.tape_width_m
                edge.append(turn @ (centre + radius * direction))
    return np.array(inner), np.array(outer)


def _add_car(mujoco: Any, spec: Any, config: LabConfig) -> None:
    """A simple car for pictures of the lab from outside; the car's own cameras never draw it."""
    car = config.car
    body = spec.worldbody.add_body()
    body.name = "car"
    body.mocap = True
    middle, half_l, half_w = 0.5 * car.wheelbase_m, 0.5 * car.body_length_m, 0.5 * car.body_width_m
    solids = [
        Solid("box", (middle, 0.0, 0.085), (half_l, 0.6 * half_w, 0.035), (0.15, 0.15, 0.17)),
        Solid("box", (middle - 0.03, 0.0, 0.15), (0.7 * half_l, 0.55 * half_w, 0.03), (0.75, 0.16, 0.14)),
        Solid("box", (config.camera.x_m - 0.02, 0.0, 0.19), (0.015, 0.07, 0.02), (0.1, 0.1, 0.1)),
    ]
    for x in (0.0, car.wheelbase_m):
        for y in (-1, 1):
            wheel = add_geom(body, mujoco.mjtGeom.mjGEOM_CYLINDER, (0.055, 0.025, 0.0))
            wheel.pos = [x, y * (half_w - 0.025), 0.055]
            wheel.quat = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
            wheel.rgba = [0.08, 0.08, 0.08, 1.0]
            wheel.group = CAR_GROUP
    for solid in solids:
        _add_solid(mujoco, body, solid).group = CAR_GROUP
