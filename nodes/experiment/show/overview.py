"""The world from above, with paths and objects drawn in, for reports."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from advnerf_core.geometry import Array, invert_transform, transform_points
from hardware.worlds.world import Overview, Rgb, World
from nodes.experiment.show.context import Experiment

_PATHS_RGB = ((40, 110, 230), (235, 140, 20), (200, 40, 170), (20, 150, 110), (120, 80, 200), (150, 110, 40))
_OBJECT_RGB, _EDGE_RGB, _PAPER = (240, 30, 30), (150, 150, 150), 255
_WIDTH, _HEIGHT, _MARGIN_M = 960, 720, 3.0
_ABOVE_GROUND_M, _SPACING_M = 0.05, 0.25

Project = Callable[[Array], Array]


def from_above(experiment: Experiment, world: World) -> Rgb:
    """Picture ``[H, W, 3]`` of an open world: its own view from above if it has one, else a plan on white paper."""
    picture, project = _photographed(world) if isinstance(world, Overview) else _plan(experiment)
    driven_m = experiment.config.horizon * experiment.config.dt_s * experiment.car.speed_mps
    for index, reference in enumerate(experiment.references.values()):
        along = np.arange(0.0, driven_m, _SPACING_M)
        points = np.array([[*reference.pose_at(float(s))[:2], _ABOVE_GROUND_M] for s in along])
        _draw(picture, project(points), _PATHS_RGB[index % len(_PATHS_RGB)], False)
    for thing in experiment.objects:
        corners = np.array([[x, y, thing.z_m] for x, y in thing.corners_m()])
        _draw(picture, project(corners), _OBJECT_RGB, True)
    return picture


def _photographed(world: Overview) -> tuple[Rgb, Project]:
    """The world's own view from above, and the projection of points ``[..., 3]`` into it [px]."""
    picture, pinhole, T = world.overview()
    return picture.copy(), lambda points: pinhole.project(transform_points(invert_transform(T), points))


def _plan(experiment: Experiment) -> tuple[Rgb, Project]:
    """White paper with the edges of the roads, and the projection of points ``[..., 3]`` onto it [px]."""
    edges = experiment.world.road_edge
    seen = [
        np.array([lane.pose_at(float(s))[:2] for s in np.linspace(0.0, lane.length_m, 50)])
        for lane in experiment.world.lanes
    ]
    seen += [np.array(thing.corners_m()) for thing in experiment.objects]
    every = np.concatenate(seen)
    low, high = every.min(axis=0) - _MARGIN_M, every.max(axis=0) + _MARGIN_M
    scale = float(min(np.array([_WIDTH, _HEIGHT]) / (high - low)))
    middle = 0.5 * (low + high)

    def project(points: Array) -> Array:
        across, up = ((points[..., axis] - middle[axis]) * scale for axis in (0, 1))
        return np.asarray(np.stack([0.5 * _WIDTH + across, 0.5 * _HEIGHT - up], axis=-1), dtype=np.float64)

    picture = np.full((_HEIGHT, _WIDTH, 3), _PAPER, np.uint8)
    for edge in edges:
        _draw(picture, project(edge), _EDGE_RGB, False)
    return picture, project


def _draw(picture: Rgb, pixels: Array, rgb: tuple[int, int, int], closed: bool) -> None:
    line = np.rint(pixels * 16.0).astype(np.int32)[:, None]
    cv2.polylines(picture, [line], closed, rgb, thickness=2, lineType=cv2.LINE_AA, shift=4)
