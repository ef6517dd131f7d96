"""A face on a panel of the world: its object in the learned scene, the space of its colours, and its presentation in training and deployment."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from advnerf_core.attack.artifact import TEXTURE_PX, face_texture
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.attack.spaces.space import FaceMount, FaceSpace, NamedObject
from advnerf_core.display import DisplayModel
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object, face_corners_in_object
from advnerf_core.geometry import Array, invert_transform, make_transform, planar_pose, planar_poses
from advnerf_core.plugins import unknown
from advnerf_core.scene.surrogate import BackgroundRenderer, Surrogate
from calibration.display_colour import DisplayCalibration
from calibration.schema import load_calibration
from hardware.worlds.world import Panel, Rgb, World
from nodes.experiment.plan.carriers import FaceCarrier, ScreenConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.show.screen import cos_angle, face_picture, plain_picture, screens_of
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
    """Picture of the screen without an attack."""
    return plain_picture(panel_of(experiment), wanted_face(experiment).plain_rgb)


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
