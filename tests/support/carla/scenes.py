"""Drives of the scripted scene, and whether its world was put back."""

import numpy as np

from advnerf_core.geometry import transform_points
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.scene import CarlaScene


def scene_of(library, settings, **changes):
    return CarlaScene(CarlaConfig.model_validate({**settings, **changes}), library)


def drive(library, settings, steps, error=None):
    """A whole drive, which the script, or an error of ours, ends early."""
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe()
        for _ in range(steps):
            scene.step(0.0, 6.0, 0.1)
        if error is not None:
            raise error


def is_put_back(world):
    s = world.settings
    same = (
        not s.synchronous_mode and not s.fixed_delta_seconds and not world.lights_frozen and not world.actors
    )
    return same and world.weather == world.library.WeatherParameters()


def carla_points(scene, world_points):
    """Independent of the code under test: mirror after the frame's matrix."""
    points = transform_points(scene.drives.frame.T_mirrored_from_world, world_points)
    return points * np.array([1.0, -1.0, 1.0])
