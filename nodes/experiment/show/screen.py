"""A screen among the panels of a world: pictures of the face on it, and its measured colours for the driving camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from advnerf_core.geometry import Array, invert_transform, transform_points
from calibration.display_colour import DisplayFit, colours_to_show, fit_display, mean_colour, screen_region
from calibration.panel import MonitorPanel
from hardware.worlds.world import Panel, Rgb, Screens, World
from nodes.runtime.errors import ConfigError

# Poses of the car for measuring the colours: distance [m], and angles to the panel's normal [rad] for the falloff.
_DISTANCE_M, _ANGLES_RAD = 1.1, (0.0, 0.5, -0.85)


def face_picture(panel: Panel, texture: Rgb) -> Rgb:
    """A square face ``[n, n, 3]`` in true size in the middle of a black screen, as the monitor node shows it."""
    assert panel.screen_px is not None, "a board shows no pictures"
    pixels = MonitorPanel(panel.screen_px, (panel.width_m, panel.height_m))
    return pixels.picture(texture, (panel.square_m, panel.square_m))


def plain_picture(panel: Panel, rgb: Sequence[float]) -> Rgb:
    """The screen without an attack: the face in one colour (0..1)."""
    return face_picture(panel, np.full((8, 8, 3), np.round(255.0 * np.asarray(rgb)), np.uint8))


def screens_of(world: World) -> Screens:
    """The world, which must have screens.

    Raises:
        ConfigError: The world cannot show a picture.
    """
    if not isinstance(world, Screens):
        raise ConfigError(
            f"expected a world with a method show(panel, rgb), as one of its panels is a screen, got {type(world).__name__} without"
        )
    return world


def cos_angle(panel: Panel, points: Array) -> Array:
    """Cosine ``[...]`` of the angle between a panel's normal and the direction to points ``[..., 3]``."""
    seen = transform_points(invert_transform(panel.T_world_from_face), points)
    return np.asarray(seen[..., 0] / np.linalg.norm(seen, axis=-1), dtype=np.float64)


def measure_display(
    world: World,
    name: str,
    panel: Panel,
    seed: int = 0,
    frames_of: Callable[[Rgb], Sequence[Rgb]] | None = None,
) -> DisplayFit:
    """Show the calibration's colours on a screen, look at them from three poses, and fit the display model.

    Args:
        world: The open world; its screen shows the last colour afterwards.
        frames_of: Converts a rendered picture to camera frames, such as several noisy ones; None uses the picture itself.
    """
    colours, screens = colours_to_show(seed=seed), screens_of(world)
    shown, seen, cosines = [], [], []
    for angle in _ANGLES_RAD:
        car = _car_before(panel, world.T_car_from_camera, angle)
        camera = np.array([*car[:2], 0.0]) + _turned(world.T_car_from_camera[:3, 3], car[2])
        pictures = []
        for colour in colours:
            screens.show(name, np.full((2, 2, 3), colour, np.uint8))
            picture = world.observe_at(*car, depth=False)[0]
            pictures.append([picture] if frames_of is None else frames_of(picture))
        region = screen_region(pictures[0][0], pictures[1][0])
        seen += [mean_colour(frames, region) for frames in pictures]
        shown += list(colours / 255.0)
        cosines += [float(cos_angle(panel, camera))] * len(colours)
    return fit_display(np.array(shown), np.array(seen), np.array(cosines))


def _car_before(panel: Panel, T_car_from_camera: Array, angle_rad: float) -> tuple[float, float, float]:
    """Pose of a car on the floor whose camera looks at a panel from an angle to its normal: x [m], y [m], yaw [rad]."""
    face, ahead_m = panel.T_world_from_face, float(T_car_from_camera[0, 3])
    place = face @ np.array([_DISTANCE_M * math.cos(angle_rad), _DISTANCE_M * math.sin(angle_rad), 0.0, 1.0])
    towards = face[:3, 3] - place[:3]
    heading = math.atan2(towards[1], towards[0])
    return (
        float(place[0] - ahead_m * math.cos(heading)),
        float(place[1] - ahead_m * math.sin(heading)),
        heading,
    )


def _turned(offset: Array, yaw_rad: float) -> Array:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1], offset[2]])
