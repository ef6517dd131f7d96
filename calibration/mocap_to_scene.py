"""Calibrates pose and scale of a learned scene in the motion-capture world, from cameras with poses in both.

Structure from motion leaves scale and frame open. Frames taken on the tracked car (or with a tracked phone) have poses in both worlds; the
similarity is `advnerf_core.data.similarity.align_poses` (Umeyama 1991 with consensus). It is judged on cameras it was not fitted to.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from advnerf_core.data.similarity import Alignment, SimilarityError, align_poses, rotation_angles
from advnerf_core.geometry import Array
from calibration.degeneracy import DegenerateDataError, PoorFitError, require_count
from calibration.measured import SceneCalibration, rows_of

# Fewer cameras with a pose in both worlds are refused.
_MIN_CAMERAS = 12
# Cameras farther from their motion-capture place are outliers [m].
_POSITION_TOLERANCE_M = 0.08
# Cameras turned farther are outliers [rad].
_ROTATION_TOLERANCE_RAD = float(np.radians(3.0))
# With a smaller share of inliers the set is refused.
_MIN_SHARE = 0.5
# The cameras are left out in this many turns, to see how well the others place them.
_FOLDS = 4
# A larger median error of left-out inliers is refused [m].
_MOST_HELD_OUT_M = 0.05


@dataclass(frozen=True, eq=False)
class SceneFit:
    """A placed scene.

    Attributes:
        alignment: Similarity, inliers and residuals of all cameras.
        names: Names of the cameras, in the order of the residuals.
        held_out_m: Distance of each inlier from its place by the similarity of the others ``[I]`` [m].
        held_out_rad: Angle of the same ``[I]`` [rad].
        T_world_from_camera: Motion-capture poses ``[N, 4, 4]``.
        placed: The scene's poses in the world ``[N, 4, 4]``.
    """

    alignment: Alignment
    names: tuple[str, ...]
    held_out_m: Array
    held_out_rad: Array
    T_world_from_camera: Array
    placed: Array

    @property
    def calibration(self) -> SceneCalibration:
        """Make the calibration."""
        a = self.alignment
        residuals = {
            "rms_position_m": a.rms_position_m,
            "rms_rotation_rad": a.rms_rotation_rad,
            "outliers": float((~a.inliers).sum()),
            "held_out_median_m": float(np.median(self.held_out_m)),
            "held_out_worst_m": float(self.held_out_m.max()),
            "held_out_median_rad": float(np.median(self.held_out_rad)),
            "extent_m": a.extent_m,
        }
        return SceneCalibration(
            date=datetime.date.today(),
            method="similarity of camera poses (Umeyama with consensus), judged on cameras left out in turn",
            views=int(a.inliers.sum()),
            residuals={key: round(value, 6) for key, value in residuals.items()},
            scale=float(a.similarity.scale),
            T_world_from_scene=rows_of(a.similarity.T_target_from_source),
        )


def place_scene(
    T_scene_from_camera: Mapping[str, Array],
    T_world_from_camera: Mapping[str, Array],
) -> SceneFit:
    """Find the similarity from a scene to the motion-capture world.

    Args:
        T_scene_from_camera: Poses ``[4, 4]`` in the scene, by image name.
        T_world_from_camera: Poses ``[4, 4]`` in the world, by image name; only names in both count.

    Raises:
        DegenerateDataError: Too few cameras in both, or all of them on one line.
        PoorFitError: Too few agree, or left-out cameras are misplaced.
    """
    names = tuple(name for name in T_scene_from_camera if name in T_world_from_camera)
    cure = "the images of both must have the same file names; take more frames of the car into the scene's reconstruction"
    require_count(len(names), _MIN_CAMERAS, "cameras with a pose in both worlds", cure)
    source = np.stack([np.asarray(T_scene_from_camera[name], np.float64) for name in names])
    target = np.stack([np.asarray(T_world_from_camera[name], np.float64) for name in names])
    alignment = _align(source, target, _MIN_SHARE)
    inside = np.flatnonzero(alignment.inliers)
    require_count(len(inside), _MIN_CAMERAS, "cameras that agree", "take more frames on curves of the drive")
    far, angle = _held_out(source[inside], target[inside])
    if float(np.median(far)) > _MOST_HELD_OUT_M:
        raise PoorFitError(
            f"expected cameras that were left out to be placed within {100 * _MOST_HELD_OUT_M:.0f} cm, got {100 * np.median(far):.1f} cm in the "
            "median: does the reconstruction bend, are the stamps right, is the mounting pose that of this camera?"
        )
    return SceneFit(alignment, names, far, angle, target, alignment.similarity.poses(source))


def _align(source: Array, target: Array, share: float) -> Alignment:
    try:
        return align_poses(source, target, _POSITION_TOLERANCE_M, _ROTATION_TOLERANCE_RAD, share)
    except SimilarityError as error:
        kind = DegenerateDataError if "line" in str(error) or "place" in str(error) else PoorFitError
        raise kind(str(error)) from error


def _held_out(source: Array, target: Array) -> tuple[Array, Array]:
    """Errors of each camera under the similarity of the others, in blocks of neighbours, as adjacent frames are not independent."""
    fold = np.arange(len(source)) * _FOLDS // len(source)
    far, angle = np.empty(len(source)), np.empty(len(source))
    for k in range(_FOLDS):
        out = fold == k
        moved = _align(source[~out], target[~out], 0.5).similarity.poses(source[out])
        far[out] = np.linalg.norm(moved[:, :3, 3] - target[out, :3, 3], axis=1)
        angle[out] = rotation_angles(np.swapaxes(moved[:, :3, :3], 1, 2) @ target[out, :3, :3])
    return far, angle
