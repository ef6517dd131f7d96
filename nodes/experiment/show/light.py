"""The light on a panel: the response from painted colours to the driving camera's, measured with plain colours alone.

The model equals a monitor's (`advnerf_core.display`): a curve for each channel, a mixing matrix, ambient light, and the camera's power.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.display import DisplayModel
from advnerf_core.fields.voxel_grid import face_corners_in_object
from advnerf_core.geometry import invert_transform, planar_pose, transform_points
from calibration.display_colour import (
    DisplayCalibration,
    DisplayFit,
    colours_to_show,
    fit_display,
    mean_colour,
)
from calibration.schema import CalibrationError, load_calibration
from hardware.worlds.paths import Pose
from hardware.worlds.world import NativePanels, Panel, World
from nodes.experiment.plan.placed import PANEL, PlacedObject
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.placing import seen_from
from nodes.runtime.errors import ConfigError

LIGHT = "panel_light.yaml"
# Share of a panel's side that is measured, without its edge; number of poses, and least number of pixels.
_INSIDE, _POSES, _LEAST_PX = 0.8, 3, 20
_NAME = "light"
# Shares of its own brightness between which a panel's light is no matter, and the grey that is looked at.
_AS_BRIGHT, _GREY = (0.75, 1.33), 128
# Without a room's glare on glass, black is black: primaries leave two channels dark.
_LEAST_FREE = 0.4


def light_on_panels(experiment: Experiment) -> DisplayModel | None:
    """The light on the panel, measured in the capture stage; None for the identity."""
    if experiment.config.carrier.response == "identity":
        return None
    return load_calibration(DisplayCalibration, experiment.calibration_folder / LIGHT).display


def measure_light(experiment: Experiment, world: World) -> DisplayFit:
    """Show plain colours on the one placed panel, look at them along the drive, and fit the response. The panel is taken away afterwards.

    Raises:
        ConfigError: No drive sees the panel large enough, or the model does not fit the light, such as one that depends on where the car is.
    """
    assert isinstance(world, NativePanels), "experiments are refused where their world takes no panels"
    (thing,) = experiment.objects
    poses = _poses(experiment, world, thing)
    if not poses:
        raise ConfigError(
            f"{experiment.file}: expected the panel {thing.name} to be seen on the way along {experiment.config.paths[0]}, with {_LEAST_PX} pixels "
            "inside its edge; it is hidden, turned away or too small: move it, or set carrier.response=identity"
        )
    panel = Panel(thing.T_world_from_face, thing.side_m, thing.side_m)
    colours = colours_to_show(seed=experiment.config.capture.seed)
    seen: list[NDArray[np.float64]] = []
    try:
        for colour in colours:
            world.add_panel(_NAME, panel, np.full((2, 2, 3), colour, np.uint8))
            pictures = [world.observe_at(*pose, depth=False)[0] for pose in poses]
            seen += [
                mean_colour([picture], _region(experiment, thing, pose))
                for picture, pose in zip(pictures, poses, strict=True)
            ]
    finally:
        world.add_panel(_NAME, panel, None)
    # Paint has no falloff: the viewing angle does not matter.
    try:
        return fit_display(
            np.repeat(colours / 255.0, len(poses), axis=0), np.array(seen), least_free=_LEAST_FREE
        )
    except CalibrationError as error:
        found = str(error).partition(": ")[0]  # what follows helps with a monitor in front of a camera
        raise ConfigError(
            f"{experiment.file}: carrier.response measured: expected light on the panel {thing.name} that does not depend on where the car is, and "
            f"a curve per channel that fits it, got: {found}; set carrier.response=identity"
        ) from error


def light_remark(experiment: Experiment, world: World) -> str:
    """A warning that names panels which the world lights otherwise than the learned scene, which shows their own colours; empty if there are none."""
    looks = {
        each.name: _brightness(experiment, world, each) for each in experiment.objects if each.kind == PANEL
    }
    dark, bright = _AS_BRIGHT
    off = [f"{name} {share:.2f}" for name, share in looks.items() if share and not dark < share < bright]
    if not off:
        return ""
    return (
        f"warning: {experiment.file}: expected panels that this world shows as bright as their own colours, which the learned scene shows, got these "
        f"times as bright: {', '.join(off)}; what is found there is weaker here: set carrier.response=measured (for one panel), or turn them to the light"
    )


def _brightness(experiment: Experiment, world: World, thing: PlacedObject) -> float:
    """How bright a grey panel looks in the middle of the views of it, as a share of its grey; 0 if no drive sees it large enough."""
    assert isinstance(world, NativePanels), "experiments are refused where their world takes no panels"
    poses = _poses(experiment, world, thing)
    if not poses:
        return 0.0
    pose = poses[len(poses) // 2]
    panel = Panel(thing.T_world_from_face, thing.side_m, thing.side_m)
    try:
        world.add_panel(_NAME, panel, np.full((2, 2, 3), _GREY, np.uint8))
        picture = world.observe_at(*pose, depth=False)[0]
    finally:
        world.add_panel(_NAME, panel, None)
    return float(mean_colour([picture], _region(experiment, thing, pose)).mean() * 255.0 / _GREY)


def _poses(experiment: Experiment, world: World, thing: PlacedObject) -> list[Pose]:
    """First, middle and last of the poses with a large enough view of the panel; none if the drive has no such view."""
    found = [
        pose
        for pose in seen_from(experiment, world, thing, 1.0)
        if _region(experiment, thing, pose).sum() >= _LEAST_PX
    ]
    count = min(_POSES, len(found))
    return [found[index] for index in np.linspace(0, len(found) - 1, count).round().astype(int)]


def _region(experiment: Experiment, thing: PlacedObject, pose: Pose) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` of the driving camera well inside the panel."""
    corners = face_corners_in_object(_INSIDE * thing.side_m)
    T_camera_from_world = invert_transform(planar_pose(*pose) @ experiment.mount)
    pixels = (
        experiment.camera.project(transform_points(T_camera_from_world @ thing.T_world_from_face, corners))
        - 0.5
    )
    region = np.zeros((experiment.camera.height, experiment.camera.width), np.uint8)
    cv2.fillConvexPoly(region, np.round(16 * pixels).astype(np.int32), 1, shift=4)
    return cv2.erode(region, np.ones((3, 3), np.uint8), borderValue=0) > 0
