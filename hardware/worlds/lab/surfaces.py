"""The room's painted surfaces with their light: computed once, before MuJoCo is involved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from advnerf_core.geometry import Array
from hardware.worlds.lab import lighting, textures
from hardware.worlds.lab.config import Colour, LabConfig, RoomConfig
from hardware.worlds.lab.furniture import Solid, furnish
from hardware.worlds.lab.textures import Image

UP, EAST, NORTH = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
LIGHT_CELLS = 64  # per room side; shadows of lamps a metre wide need no more
TAPE_PIXELS = 256


@dataclass(frozen=True)
class Surface:
    """A rectangle seen from one side, and its picture.

    Attributes:
        name: Unique name.
        centre_m: Centre ``[3]`` [m].
        right: Unit vector ``[3]`` to the viewer's right.
        up: Unit vector ``[3]`` towards row 0 of the picture.
        half_m: Half of the width and height [m].
        image: Picture ``[H, W, 3]`` in 0..1, lit.
    """

    name: str
    centre_m: Array
    right: Array
    up: Array
    half_m: tuple[float, float]
    image: Image

    @property
    def normal(self) -> Array:
        """Outward unit normal ``[3]``."""
        return np.asarray(np.cross(self.right, self.up), dtype=np.float64)


def paint_room(config: LabConfig) -> tuple[dict[str, Surface], Image]:
    """Paint floor, ceiling and walls and bake their light; a second lab of the same room reuses them, whatever its cameras are.

    Returns:
        The surfaces by name, and the lit tape colour as a picture over the whole floor.
    """
    return _painted(config.room, config.track.tape_rgb, tuple(furnish(config)) if config.shadows else ())


@lru_cache(maxsize=2)
def _painted(
    room: RoomConfig, tape_rgb: Colour, occluders: tuple[Solid, ...]
) -> tuple[dict[str, Surface], Image]:
    half, middle = 0.5 * room.side_m, 0.5 * room.height_m
    rng = np.random.default_rng(room.seed)
    floor = textures.floor_image(room.side_m, rng)
    walls = textures.wall_images(room.side_m, room.height_m, rng)
    ceiling = textures.ceiling_image(room.side_m, rng)
    surfaces = [
        Surface("floor", np.zeros(3), EAST, NORTH, (half, half), floor),
        Surface("ceiling", room.height_m * UP, EAST, -NORTH, (half, half), ceiling),
    ]
    for name, inward in (("south", NORTH), ("east", -EAST), ("north", -NORTH), ("west", EAST)):
        right = np.asarray(np.cross(UP, inward), dtype=np.float64)
        surfaces.append(Surface(name, middle * UP - half * inward, right, UP, (half, middle), walls[name]))
    tape: Image = np.full((TAPE_PIXELS, TAPE_PIXELS, 3), tape_rgb, dtype=np.float32)
    lit = {}
    for surface in surfaces:
        if surface.name == "ceiling":
            lit[surface.name] = surface
            continue
        light = _light(room, surface, occluders)
        lit[surface.name] = replace(surface, image=textures.with_light(surface.image, light))
        if surface.name == "floor":
            tape = textures.with_light(tape, light)
    return lit, tape


def _light(room: RoomConfig, surface: Surface, occluders: Sequence[Solid]) -> Array:
    """Coarse map ``[h, w]`` of the light on a surface, row 0 on top."""
    lamps = lighting.lamp_samples(0.5 * room.side_m, room.height_m)
    cell = room.side_m / LIGHT_CELLS
    columns, rows = (max(round(2.0 * half / cell), 1) for half in surface.half_m)
    u = ((np.arange(columns) + 0.5) / columns * 2.0 - 1.0) * surface.half_m[0]
    v = (1.0 - (np.arange(rows) + 0.5) / rows * 2.0) * surface.half_m[1]
    points = surface.centre_m + u[None, :, None] * surface.right + v[:, None, None] * surface.up
    return lighting.irradiance(points.reshape(-1, 3), surface.normal, lamps, occluders).reshape(rows, columns)
