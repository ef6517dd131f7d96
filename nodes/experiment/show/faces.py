"""A face on a panel of the world: its object in the learned scene, the space of its colours, and its presentation in training and deployment.

Of a panel that is a screen also its pictures of the face, and its measured colours for the driving camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from torch import Tensor

from advnerf_core.attack.artifact import TEXTURE_PX, face_texture
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.attack.spaces.space import FaceMount, FaceSpace, NamedObject
from advnerf_core.display import DisplayModel
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object, face_corners_in_object
from advnerf_core.geometry import (
    Array,
    invert_transform,
    make_transform,
    planar_pose,
    planar_poses,
    transform_points,
)
from advnerf_core.plugins import unknown
from advnerf_core.scene.surrogate import BackgroundRenderer, Surrogate
from calibration.display_colour import (
    DisplayCalibration,
    DisplayFit,
    colours_to_show,
    fit_display,
    mean_colour,
    screen_region,
)
from calibration.panel import MonitorPanel
from calibration.schema import load_calibration
from hardware.worlds.world import Panel, Rgb, Screens, World
from nodes.experiment.plan.carriers import FaceCarrier, ScreenConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed
from nodes.experiment.show.learned_scene import load_background
from nodes.runtime.errors import ConfigError

# The deployed face lies this far in front of the panel that carries it, so that it is never inside it.
FACE_OFFSET_M = 0.01
DISPLAY = "display.yaml"


def has_face(experiment: Experiment) -> bool:
    """Whether the attack is a face on a panel."""
    return isinstance(experiment.config.carrier, FaceCarrier)


def wanted_face(experiment: Experiment) -> FaceCarrier:
    """The section ``carrier`` of an experiment that attacks a face."""
    assert isinstance(experiment.config.carrier, FaceCarrier), "only asked where a face is attacked"
    return experiment.config.carrier


def panel_of(experiment: Experiment) -> Panel:
    """The panel of the face.

    Raises:
        ConfigError: The world has no such panel.
    """
    name, panels = wanted_face(experiment).panel, experiment.world.panels
    if name not in panels:
        raise ConfigError(f"{experiment.file}: carrier.panel: {unknown(name, 'panel', panels)}")
    return panels[name]


def on_screen(experiment: Experiment) -> bool:
    """Whether a screen shows the face; else it is projected onto a board."""
    return isinstance(experiment.config.carrier, ScreenConfig)


def face_object(experiment: Experiment) -> VoxelGridObject:
    """The visible face of the cube, on its panel, in one colour."""
    wanted, panel = wanted_face(experiment), panel_of(experiment)
    pose = panel.T_world_from_face @ make_transform(np.eye(3), [FACE_OFFSET_M, 0.0, 0.0])
    return cube_face_object(panel.square_m, wanted.resolution, wanted.plain_rgb, pose)


def display_of(experiment: Experiment) -> DisplayModel:
    """Optics of the screen for the driving camera, measured in the capture stage."""
    return load_calibration(DisplayCalibration, experiment.calibration_folder / DISPLAY).display


def face_space(
    experiment: Experiment, background: BackgroundRenderer | None = None, ideal: bool | None = None
) -> FaceSpace:
    """The colours of the face in the learned scene.

    Args:
        background: Renderer of the scene, if it is loaded already.
        ideal: Whether a screen is assumed ideal; None uses the experiment's setting.
    """
    field, panel, wanted = face_object(experiment), panel_of(experiment), wanted_face(experiment)
    surrogate = Surrogate(
        background or load_background(experiment), experiment.view.pinhole, experiment.mount, [field]
    )
    mount = FaceMount(wanted.panel, (panel.square_m, panel.square_m), face_corners_in_object(panel.square_m))
    named = NamedObject("face", field.sha256)
    if not isinstance(wanted, ScreenConfig) or (not wanted.display_model if ideal is None else ideal):
        return FaceSpace(surrogate, [named], mount=mount)
    return FaceSpace(surrogate, [named], display_of(experiment), mean_cos_angle(experiment), mount)


def mean_cos_angle(experiment: Experiment) -> float:
    """Cosine of the camera's viewing angle to the panel, averaged over the measured stretch of all paths where the panel is visible."""
    panel, ticks = panel_of(experiment), np.arange(experiment.config.horizon + 1)
    parts = []
    for name, path in experiment.paths.items():
        start_s_m = float(path.project(np.array(experiment.references[name].drive_start[:2])).s_m)
        along = path.pose_at(start_s_m + ticks * experiment.car.speed_mps * experiment.config.dt_s)
        cameras = planar_poses(along) @ experiment.mount
        towards = panel.T_world_from_face[:3, 3] - cameras[:, :3, 3]
        ahead = np.einsum("ni,ni->n", towards, cameras[:, :3, 2]) > 0.0
        cosines = cos_angle(panel, cameras[:, :3, 3])
        parts.append(cosines[ahead & (cosines > 0.0)])
    seen = np.concatenate(parts)
    return float(seen.mean()) if seen.size else 1.0


def plain_screen(experiment: Experiment) -> Rgb:
    """Picture of the screen without an attack: the face in one colour."""
    colour = np.round(255.0 * np.asarray(wanted_face(experiment).plain_rgb))
    return face_picture(panel_of(experiment), np.full((8, 8, 3), colour, np.uint8))


class PaintedScene(Dressed):
    """A deployment scene with a face on its panel, as the policy sees it.

    A board's face is drawn by the same code as live; a screen shows it, and the scene is rendered again, as no projection models its optics.
    """

    def __init__(self, experiment: Experiment, scene: World, texture_px: int = TEXTURE_PX) -> None:
        self.scene, self.view = scene, experiment.view
        self._panel, self._name, self._px = panel_of(experiment), wanted_face(experiment).panel, texture_px
        self._plain = plain_screen(experiment) if on_screen(experiment) else None
        self._T_camera_from_car = invert_transform(scene.T_car_from_camera)
        if self._plain is not None:
            screens_of(scene).show(self._name, self._plain)

    def plain_theta(self) -> None:
        """None: without an attack nothing is drawn."""
        return

    def camera_image(self, state: Array, theta: Tensor | None) -> Rgb:
        """See `Dressed.camera_image`."""
        if theta is not None and self._plain is not None:
            return self._on_screen(state, theta)
        rgb = self._observed(state)
        return rgb if theta is None else self._on_board(rgb, state, theta)

    def paint(self, rgb: Rgb, state: Array, theta: Tensor) -> Rgb:
        """See `Dressed.paint`; a board's face is drawn into the image."""
        return self._on_board(rgb, state, theta) if self._plain is None else self._on_screen(state, theta)

    def _observed(self, state: Array) -> Rgb:
        x_m, y_m, yaw_rad = map(float, state[:3])
        return self.scene.observe_at(x_m, y_m, yaw_rad, depth=False)[0]

    def _on_board(self, rgb: Rgb, state: Array, theta: Tensor) -> Rgb:
        corners = face_corners_in_object(self._panel.square_m)
        overlay = FaceOverlay(self._texture(theta), corners, self.view.camera)
        T_camera_from_world = self._T_camera_from_car @ invert_transform(planar_pose(*map(float, state[:3])))
        return overlay.draw(rgb, T_camera_from_world @ self._panel.T_world_from_face)[0]

    def _on_screen(self, state: Array, theta: Tensor) -> Rgb:
        screens = screens_of(self.scene)
        screens.show(self._name, face_picture(self._panel, self._texture(theta)))
        painted = self._observed(state)
        screens.show(self._name, self._plain)
        return painted

    def _texture(self, theta: Tensor) -> Rgb:
        return face_texture(theta.detach().numpy(), self._px)


# Poses of the car for measuring the colours: distance [m], and angles to the panel's normal [rad] for the falloff.
_DISTANCE_M, _ANGLES_RAD = 1.1, (0.0, 0.5, -0.85)


def face_picture(panel: Panel, texture: Rgb) -> Rgb:
    """A square face ``[n, n, 3]`` in true size in the middle of a black screen, as the monitor node shows it."""
    assert panel.screen_px is not None, "a board shows no pictures"
    pixels = MonitorPanel(panel.screen_px, (panel.width_m, panel.height_m))
    return pixels.picture(texture, (panel.square_m, panel.square_m))


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
        camera = transform_points(planar_pose(*car), world.T_car_from_camera[:3, 3])
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
