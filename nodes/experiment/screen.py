"""The lab's monitor as an experiment uses it: pictures of the face, and the monitor's colours measured by the driving camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.geometry import Array, invert_transform, planar_pose, planar_poses, transform_points
from advnerf_core.scene.surrogate import Surrogate
from calibration.display_colour import DisplayFit, colours_to_show, fit_display, mean_colour, screen_region
from calibration.panel import Panel
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.monitor import ScreenOptics
from hardware.worlds.lab.world import MONITOR_PIXELS
from nodes.experiment.context import Experiment

Rgb = NDArray[np.uint8]
# Where the car stands while the colours are shown: distance [m], and angles to the panel's normal [rad] for the falloff.
_DISTANCE_M, _ANGLES_RAD = 1.1, (0.0, 0.5, -0.85)


def face_picture(experiment: Experiment, texture: Rgb) -> Rgb:
    """A face ``[n, n, 3]`` in true size in the middle of a black screen, as the monitor node shows it."""
    panel = Panel(MONITOR_PIXELS, (experiment.panel.width_m, experiment.panel.height_m))
    return panel.picture(texture, (experiment.face_m, experiment.face_m))


def plain_picture(experiment: Experiment) -> Rgb:
    """The screen without an attack: the face in its plain colour."""
    plain = np.round(255.0 * np.array(experiment.config.object.plain_rgb))
    return face_picture(experiment, np.full((8, 8, 3), plain, np.uint8))


def measure_display(
    lab: Lab, seed: int = 0, frames_of: Callable[[Rgb], Sequence[Rgb]] | None = None
) -> DisplayFit:
    """Show the calibration's colours on the lab's monitor, look at them from three places, fit the display model.

    Args:
        lab: The lab; its monitor shows the last colour afterwards.
        seed: Of the mixed colours.
        frames_of: What a camera makes of a rendered picture, such as several noisy frames; None takes the picture as it is.
    """
    colours = colours_to_show(seed=seed)
    optics = ScreenOptics(lab.config.monitor_optics, lab.config.monitor, MONITOR_PIXELS)
    shown, seen, cosines = [], [], []
    for angle in _ANGLES_RAD:
        car = _car_before_screen(lab, angle)
        cosine = optics.cos_angle((car @ lab.config.camera.T_car_from_camera)[:3, 3])
        pictures = []
        for colour in colours:
            lab.set_monitor_image(np.full((2, 2, 3), colour, np.uint8))
            picture = lab.observe_held(car)
            pictures.append([picture] if frames_of is None else frames_of(picture))
        region = screen_region(pictures[0][0], pictures[1][0])
        seen += [mean_colour(frames, region) for frames in pictures]
        shown += list(colours / 255.0)
        cosines += [cosine] * len(colours)
    return fit_display(np.array(shown), np.array(seen), np.array(cosines))


def _car_before_screen(lab: Lab, angle_rad: float) -> Array:
    """Pose ``[4, 4]`` of a car on the floor whose camera looks at the screen from an angle to its normal."""
    face, camera = lab.config.monitor.T_world_from_face, lab.config.camera
    place = face @ np.array([_DISTANCE_M * math.cos(angle_rad), _DISTANCE_M * math.sin(angle_rad), 0.0, 1.0])
    towards = face[:3, 3] - place[:3]
    heading = math.atan2(towards[1], towards[0])
    x_m, y_m = (
        float(place[i] - camera.x_m * side) for i, side in enumerate((math.cos(heading), math.sin(heading)))
    )
    return planar_pose(x_m, y_m, heading)


def mean_cos_angle(experiment: Experiment) -> float:
    """Cosine of the angle at which the camera looks at the panel, in the mean of the measured stretch of the path, while it sees it."""
    ticks = np.arange(experiment.config.horizon + 1)
    start_s_m = float(experiment.path.project(np.array(experiment.room.start_pose[:2])).s_m)
    along = experiment.path.pose_at(start_s_m + ticks * experiment.speed_mps * experiment.dynamics.dt_s)
    cameras = planar_poses(along) @ experiment.camera.mount
    middle = experiment.panel.T_world_from_face[:3, 3]
    from_face = transform_points(invert_transform(experiment.panel.T_world_from_face), cameras[:, :3, 3])
    ahead = np.einsum("ni,ni->n", middle - cameras[:, :3, 3], cameras[:, :3, 2]) > 0.0
    cosines = from_face[:, 0] / np.linalg.norm(from_face, axis=1)
    seen = cosines[ahead & (cosines > 0.0)]
    return float(seen.mean()) if seen.size else 1.0


def shown(experiment: Experiment, surrogate: Surrogate) -> DisplayedSensor:
    """The surrogate behind the measured monitor: its ``theta`` is what is shown."""
    return DisplayedSensor(surrogate, experiment.display, mean_cos_angle(experiment))
