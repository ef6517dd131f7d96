"""The world from above, with paths and objects drawn in, for reports."""

from __future__ import annotations

import cv2
import numpy as np

from advnerf_core.geometry import Array, invert_transform, transform_points
from hardware.worlds.world import Overview, Rgb, World
from nodes.experiment.show.context import Experiment

_PATHS_RGB = ((40, 110, 230), (235, 140, 20), (200, 40, 170), (20, 150, 110), (120, 80, 200), (150, 110, 40))
_OBJECT_RGB = (240, 30, 30)
_ABOVE_GROUND_M, _SPACING_M = 0.05, 0.25


def from_above(experiment: Experiment, world: World) -> Rgb | None:
    """An open world's own view from above ``[H, W, 3]``; None if it has none: the page then draws a map of the drives."""
    if not isinstance(world, Overview):
        return None
    photograph, pinhole, T = world.overview()
    picture = photograph.copy()

    def project(points: Array) -> Array:
        return pinhole.project(transform_points(invert_transform(T), points))

    driven_m = experiment.config.horizon * experiment.config.dt_s * experiment.car.speed_mps
    for index, reference in enumerate(experiment.references.values()):
        along = np.arange(0.0, driven_m, _SPACING_M)
        points = np.array([[*reference.pose_at(float(s))[:2], _ABOVE_GROUND_M] for s in along])
        _draw(picture, project(points), _PATHS_RGB[index % len(_PATHS_RGB)], False)
    for thing in experiment.objects:
        corners = np.array([[x, y, thing.z_m] for x, y in thing.corners_m()])
        _draw(picture, project(corners), _OBJECT_RGB, True)
    return picture


def _draw(picture: Rgb, pixels: Array, rgb: tuple[int, int, int], closed: bool) -> None:
    line = np.rint(pixels * 16.0).astype(np.int32)[:, None]
    cv2.polylines(picture, [line], closed, rgb, thickness=2, lineType=cv2.LINE_AA, shift=4)
