"""The intersection as a MuJoCo model, built in memory: unlit pictures that keep their painted colours, and no lights."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from hardware.worlds.junction import pictures
from hardware.worlds.junction.config import IntersectionConfig, RoadConfig
from hardware.worlds.junction.facades import facade
from hardware.worlds.junction.ground import PAINT_M, ground, markings
from hardware.worlds.junction.pictures import swatch_u
from hardware.worlds.junction.sky import backdrop
from hardware.worlds.junction.solids import (
    BRIGHTEST,
    TexturedSolid,
    block,
    crown,
    gable,
    joined,
    polygon,
    post,
    shade,
)
from hardware.worlds.junction.town import BOXES, HEDGES, HOUSES, LAMPS, STOP_SIGN, TREES, WALLS, House
from hardware.worlds.lab import textures
from hardware.worlds.lab.gl import load_mujoco
from hardware.worlds.lab.surfaces import EAST, NORTH, UP, Surface
from hardware.worlds.lab.world import add_geom, add_material, add_texture


def build_model(config: IntersectionConfig) -> Any:
    """Compile the town.

    Returns:
        A ``mujoco.MjModel`` in which nothing moves.
    """
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = 0
    # The renderer averages a larger image instead, which also filters textures.
    spec.visual.quality.offsamples = 0
    surfaces, solids, plans = _painted(config.road)
    # Drawn front to back: first what hides others (trees, houses), last what is hidden (the road, the sky).
    for name in ("swatches", "pavement", "garden"):
        _add_solid(mujoco, spec, name, solids[name], plans[name])
    for surface in reversed(surfaces):
        _add_solid(mujoco, spec, surface.name, _rectangle(surface), surface.image)
    return spec.compile()


@lru_cache(maxsize=2)
def _painted(road: RoadConfig) -> tuple[list[Surface], dict[str, TexturedSolid], dict[str, textures.Image]]:
    """Flat pictures, triangles by picture, and their pictures; a second scene of the same roads reuses them."""
    rng = np.random.default_rng(road.seed)
    half = road.half_m
    surfaces = [Surface("asphalt", np.zeros(3), EAST, NORTH, (half, half), pictures.asphalt(road, rng))]
    solids = ground(road, swatch_u("kerb"))
    plans = {
        "pavement": pictures.pavement(road, rng),
        "garden": pictures.garden(road, rng),
        "swatches": pictures.swatches(BRIGHTEST),
    }
    surfaces += backdrop(road, rng)
    for index, house in enumerate(HOUSES):
        surfaces += _walls(f"house{index}", house, road.kerb_height_m, rng)
    solids["swatches"] = joined([solids["swatches"], *_furniture(road, rng)])
    return surfaces, solids, plans


def _walls(name: str, house: House, ground_m: float, rng: np.random.Generator) -> list[Surface]:
    """The walls of a house that are visible from the roads: all but the back wall."""
    (x0, x1), (y0, y1) = house.x, house.y
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), ground_m + 0.5 * house.eaves_m])
    back = {"north": "south", "south": "north", "east": "west", "west": "east"}[house.front]
    surfaces = []
    for side, normal in (("north", NORTH), ("south", -NORTH), ("east", EAST), ("west", -EAST)):
        if side == back:
            continue
        along_x = side in ("north", "south")
        width, depth = (x1 - x0, y1 - y0) if along_x else (y1 - y0, x1 - x0)
        image = facade(width, house.eaves_m, WALLS[house.wall], house.style, side == house.front, rng)
        right = np.asarray(np.cross(UP, normal), dtype=np.float64)
        half = (0.5 * width, 0.5 * house.eaves_m)
        lit = image * np.float32(shade(normal))
        surfaces.append(Surface(f"{name}_{side}", middle + 0.5 * depth * normal, right, UP, half, lit))
    return surfaces


def _furniture(road: RoadConfig, rng: np.random.Generator) -> list[TexturedSolid]:
    """Markings, roofs, trees, lamps and the stop sign: everything coloured by the swatches."""
    kerb = road.kerb_height_m
    white = (swatch_u("paint"), float(shade(UP)) / BRIGHTEST)
    solids = [polygon(np.c_[piece, np.full(len(piece), PAINT_M)], white) for piece in markings(road)]
    for house in HOUSES:
        top, u = kerb + house.eaves_m, swatch_u(house.roof)
        if house.ridge_m > 0.0:
            along_x = house.front in ("north", "south")
            solids += gable(house.x, house.y, top, top + house.ridge_m, u, swatch_u(house.wall), along_x)
        else:
            solids.append(
                block(
                    (house.x[0] - 0.2, house.x[1] + 0.2),
                    (house.y[0] - 0.2, house.y[1] + 0.2),
                    (top, top + 0.4),
                    u,
                )
            )
    for tree in TREES:
        middle = kerb + tree.height_m - tree.radius_m * 1.15
        solids.append(post(tree.x_m, tree.y_m, (kerb, middle), 0.16, swatch_u("trunk")))
        radii = (tree.radius_m, 1.15 * tree.radius_m)
        solids.append(crown((tree.x_m, tree.y_m, middle), radii, swatch_u(tree.leaves), rng))
    for x0, x1, y0, y1 in HEDGES:
        solids.append(block((x0, x1), (y0, y1), (kerb, kerb + 0.85), swatch_u("hedge")))
    for x0, x1, y0, y1, height, name in BOXES:
        solids.append(block((x0, x1), (y0, y1), (kerb, kerb + height), swatch_u(name)))
    for x, y in LAMPS:
        solids.append(post(x, y, (kerb, 5.6), 0.07, swatch_u("post")))
        solids.append(block((x - 0.25, x + 0.25), (y - 0.25, y + 0.25), (5.6, 5.75), swatch_u("lamp")))
    x, y = STOP_SIGN
    solids.append(post(x, y, (kerb, 2.0), 0.04, swatch_u("post")))
    angles = np.arange(8) * 0.25 * math.pi + 0.125 * math.pi
    for radius, ahead, name in ((0.46, 0.06, "white"), (0.41, 0.07, "sign_red")):
        rim = np.c_[x + radius * np.cos(angles), np.full(8, y - ahead), 2.3 + radius * np.sin(angles)]
        solids.append(polygon(rim, (swatch_u(name), 0.85)))
    return solids


def _rectangle(surface: Surface) -> TexturedSolid:
    """A picture's rectangle as triangles: MuJoCo's own planes are far slower to draw, and are seen from behind too."""
    right, up = surface.half_m[0] * surface.right, surface.half_m[1] * surface.up
    corners = [surface.centre_m + a * right + b * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return polygon(corners, [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def _add_solid(mujoco: Any, spec: Any, name: str, solid: TexturedSolid, image: textures.Image) -> None:
    add_texture(mujoco, spec, name, textures.to_uint8(image))
    add_material(mujoco, spec, name).emission = 1.0
    mesh = spec.add_mesh()
    mesh.name = name
    mesh.uservert = solid.vertices.ravel().tolist()
    mesh.userface = solid.faces.ravel().tolist()
    # MuJoCo counts v from row 0 of a picture, which is our top.
    mesh.usertexcoord = np.c_[solid.uv[:, 0], 1.0 - solid.uv[:, 1]].ravel().tolist()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # an open surface has no volume
    geom = add_geom(spec.worldbody, mujoco.mjtGeom.mjGEOM_MESH, (0.0, 0.0, 0.0))
    geom.meshname = name
    geom.material = name
