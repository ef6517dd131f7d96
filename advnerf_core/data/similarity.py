"""The similarity between two worlds with the same cameras: scale, rotation and translation, robust against wrong poses.

Structure from motion leaves scale and frame open; motion capture determines both. With camera centres ``p_i`` and rotations ``R_i`` in
the source world and ``q_i``, ``S_i`` in the target, the map ``q = s R p + t`` minimises
``sum_i |q_i - s R p_i - t|^2 + l^2 |S_i - R R_i|^2`` (Umeyama 1991, with the rotations as further correspondences: the axes of a
camera, at distance ``l``). The rotations determine what positions on a line leave open, and they reveal a wrong correspondence
that happens to lie in the right place. Outliers are found by consensus among pairs of cameras, each of which gives a candidate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array, make_transform

MIN_CAMERAS = 3
_CANDIDATES = 300
# Positions whose second axis is shorter than this share of the first are on a line.
_LINE_RATIO = 0.02


class SimilarityError(AdvnerfError):
    """Two sets of camera poses do not determine a similarity."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """``target = scale R source + t``.

    Attributes:
        scale: ``s`` [target units per source unit].
        T_target_from_source: Rigid part ``[4, 4]``: rotation ``R``, translation ``t`` [target units].
    """

    scale: float
    T_target_from_source: Array

    def points(self, points: ArrayLike) -> Array:
        """Points ``[..., 3]`` of the source world in the target's."""
        T = self.T_target_from_source
        return self.scale * np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]

    def poses(self, T_source_from_camera: ArrayLike) -> Array:
        """Camera poses ``[..., 4, 4]`` of the source world in the target's; they stay rigid."""
        poses = np.asarray(T_source_from_camera, np.float64)
        moved = poses.copy()
        moved[..., :3, :3] = self.T_target_from_source[:3, :3] @ poses[..., :3, :3]
        moved[..., :3, 3] = self.points(poses[..., :3, 3])
        return moved

    def after(self, first: Similarity) -> Similarity:
        """The map that applies another one first: from its source world to this target's."""
        turn = self.T_target_from_source[:3, :3] @ first.T_target_from_source[:3, :3]
        shift = self.points(first.T_target_from_source[:3, 3])
        return Similarity(self.scale * first.scale, make_transform(turn, shift))


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity and its residuals.

    Attributes:
        similarity: Map from the source to the target world.
        inliers: ``[N]`` bool: cameras that it was fitted to.
        position_error_m: ``[N]`` distance of each camera from its target [target units].
        rotation_error_rad: ``[N]`` angle of each camera from its target [rad].
        extent_m: Largest distance between two inlier target cameras [target units].
    """

    similarity: Similarity
    inliers: NDArray[np.bool_]
    position_error_m: Array
    rotation_error_rad: Array
    extent_m: float

    @property
    def rms_position_m(self) -> float:
        """Root mean square distance of the inliers."""
        return float(np.sqrt(np.mean(self.position_error_m[self.inliers] ** 2)))

    @property
    def rms_rotation_rad(self) -> float:
        """Root mean square angle of the inliers."""
        return float(np.sqrt(np.mean(self.rotation_error_rad[self.inliers] ** 2)))

    def summary(self) -> dict[str, float | int]:
        """Values for a report."""
        inside = self.inliers
        return {
            "scale": self.similarity.scale,
            "cameras": len(inside),
            "inliers": int(inside.sum()),
            "extent_m": self.extent_m,
            "rms_position_m": self.rms_position_m,
            "max_position_m": float(self.position_error_m[inside].max()),
            "rms_rotation_rad": self.rms_rotation_rad,
            "max_rotation_rad": float(self.rotation_error_rad[inside].max()),
        }


def align_poses(
    T_source_from_camera: ArrayLike,
    T_target_from_camera: ArrayLike,
    position_tolerance_m: float,
    rotation_tolerance_rad: float,
    min_inlier_share: float = 0.5,
) -> Alignment:
    """Find the similarity that takes one set of camera poses to the other.

    Args:
        T_source_from_camera: ``[N, 4, 4]``.
        T_target_from_camera: ``[N, 4, 4]`` of the same cameras.
        position_tolerance_m: Largest distance of an inlier from its target [target units]; with both tolerances infinite all count.
        rotation_tolerance_rad: Largest angle of an inlier from its target [rad].
        min_inlier_share: With fewer inliers than this share the result is rejected.

    Raises:
        SimilarityError: Too few cameras, all at one place or on one line, or too few that agree.
    """
    source, target = (
        np.asarray(T_source_from_camera, np.float64),
        np.asarray(T_target_from_camera, np.float64),
    )
    if source.shape != target.shape or source.shape[1:] != (4, 4):
        raise ValueError(
            f"expected two sets of poses [N, 4, 4] of one length, got {source.shape} and {target.shape}"
        )
    if position_tolerance_m <= 0.0 or rotation_tolerance_rad <= 0.0:
        raise ValueError("expected positive tolerances")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise SimilarityError("expected finite poses, got NaN or infinity; leave those cameras out")
    if len(source) < MIN_CAMERAS:
        raise SimilarityError(
            f"expected at least {MIN_CAMERAS} cameras with a pose in both worlds, got {len(source)}; take frames of a longer drive"
        )
    _refuse_degenerate(target[:, :3, 3], "all")
    tolerances = (position_tolerance_m, rotation_tolerance_rad)
    everything = np.isinf(tolerances).all()
    inliers = np.ones(len(source), np.bool_) if everything else _consensus(source, target, tolerances)
    _require_share(inliers, min_inlier_share, tolerances)
    for _ in range(20):  # to a fixed point; it settles after two or three rounds
        similarity = _fit(source[inliers], target[inliers])
        again = _inliers(_errors(similarity, source, target), tolerances)
        _require_share(again, min_inlier_share, tolerances)
        if (again == inliers).all():
            break
        inliers = again
    _refuse_degenerate(target[inliers, :3, 3], "agreeing")
    position, rotation = _errors(similarity, source, target)
    return Alignment(similarity, inliers, position, rotation, extent(target[inliers, :3, 3]))


def fit_positions(source: ArrayLike, target: ArrayLike, source_up: ArrayLike) -> tuple[Similarity, bool]:
    """Least-squares similarity between positions ``[N, 3]`` without rotations, into a world with z up (Umeyama 1991).

    Args:
        source_up: Up ``[3]`` in the source world. It determines the rotation about a line that all positions are on.

    Returns:
        The similarity, and whether the positions are on a line, so that ``source_up`` was used.

    Raises:
        SimilarityError: All positions are at one place, or on a vertical line.
    """
    p, q = np.asarray(source, np.float64), np.asarray(target, np.float64)
    p0, q0 = p.mean(axis=0), q.mean(axis=0)
    p, q = p - p0, q - q0
    spread = np.linalg.svd(p, compute_uv=False), np.linalg.svd(q, compute_uv=False)
    if min(each[0] for each in spread) < 1e-9:
        raise SimilarityError(
            "expected known positions at different places, got all at one; give more of them"
        )
    on_line = any(len(each) < 2 or each[1] < _LINE_RATIO * each[0] for each in spread)
    places = q.T @ p
    if on_line:
        along_p, along_q = np.linalg.svd(p)[2][0], np.linalg.svd(q)[2][0]
        along_p = along_p * np.sign((p @ along_p) @ (q @ along_q))
        if abs(along_q[2]) > 1.0 - _LINE_RATIO:
            raise SimilarityError(
                "expected known positions that are not above each other; give some elsewhere"
            )
        # Up determines the turn around the line with the same weight as the line itself.
        up_p, up_q = (_across(up, along) for up, along in ((source_up, along_p), ([0.0, 0.0, 1.0], along_q)))
        places = np.outer(along_q, along_p) + np.outer(up_q, up_p)
    R = _nearest_rotation(places)
    scale = float(np.sum(R * (q.T @ p)) / (p**2).sum())
    if scale <= 0.0:
        raise SimilarityError(
            "expected known positions in the order of the images, got a mirrored or mixed order"
        )
    return Similarity(scale, make_transform(R, q0 - scale * R @ p0)), on_line


def _across(direction: ArrayLike, line: Array) -> Array:
    """Unit vector of the part of a direction ``[3]`` that is perpendicular to a line's unit vector."""
    part = np.asarray(direction, np.float64) - (np.asarray(direction) @ line) * line
    return np.asarray(part / max(float(np.linalg.norm(part)), 1e-12))


def extent(positions: ArrayLike) -> float:
    """Largest distance between two of the positions ``[N, 3]``."""
    p = np.asarray(positions, np.float64)
    return float(np.sqrt(((p[:, None] - p[None]) ** 2).sum(axis=-1).max()))


def rotation_angles(R: Array) -> Array:
    """Angles of rotations ``[..., 3, 3]`` [rad]; accurate for small ones too, where the arc cosine is not."""
    sine = np.linalg.norm(
        np.stack(
            [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
        ),
        axis=-1,
    )
    return np.asarray(np.arctan2(sine, np.trace(R, axis1=-2, axis2=-1) - 1.0))


def _fit(source: Array, target: Array) -> Similarity:
    """Least squares over positions and rotations: alternately the rotation for a scale, and the scale for a rotation."""
    p, q = source[:, :3, 3], target[:, :3, 3]
    p0, q0 = p.mean(axis=0), q.mean(axis=0)
    p, q = p - p0, q - q0
    # Length over which the cameras are spread: then a radian counts as much as the spread it would cause.
    arm = float(np.sqrt((q**2).sum(axis=1).mean()))
    turns = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3])
    places = q.T @ p
    scale = float(np.sqrt((q**2).sum() / max((p**2).sum(), 1e-300)))
    for _ in range(50):
        R = _nearest_rotation(scale * places + arm**2 * turns)
        new = float(np.sum(R * places) / (p**2).sum())
        if abs(new - scale) <= 1e-15 * abs(scale):
            break
        scale = new
    return Similarity(scale, make_transform(R, q0 - scale * R @ p0))


def _nearest_rotation(matrix: Array) -> Array:
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _errors(similarity: Similarity, source: Array, target: Array) -> tuple[Array, Array]:
    moved = similarity.poses(source)
    position = np.linalg.norm(moved[:, :3, 3] - target[:, :3, 3], axis=1)
    return position, rotation_angles(np.swapaxes(moved[:, :3, :3], 1, 2) @ target[:, :3, :3])


def _inliers(errors: tuple[Array, Array], tolerances: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((errors[0] <= tolerances[0]) & (errors[1] <= tolerances[1]))


def _consensus(source: Array, target: Array, tolerances: tuple[float, float]) -> NDArray[np.bool_]:
    """The inliers of the best of many pairs of cameras: their rotations give R, their distance gives s."""
    count = len(source)
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    if len(pairs) > _CANDIDATES:
        rng = np.random.default_rng(0)
        pairs = [pairs[k] for k in rng.choice(len(pairs), _CANDIDATES, replace=False)]
    best: NDArray[np.bool_] = np.zeros(count, np.bool_)
    best_rank = (-1, -np.inf)
    for i, j in pairs:
        apart = source[j, :3, 3] - source[i, :3, 3]
        # A pair no farther apart than its own errors fixes no scale.
        if apart @ apart < 1e-24 or np.linalg.norm(target[j, :3, 3] - target[i, :3, 3]) <= tolerances[0]:
            continue
        similarity = _fit(source[[i, j]], target[[i, j]])
        errors = _errors(similarity, source, target)
        inside = _inliers(errors, tolerances)
        rank = (int(inside.sum()), -float(errors[0][inside].sum()))
        if similarity.scale > 0.0 and rank > best_rank:
            best, best_rank = inside, rank
    return best


def _require_share(inliers: NDArray[np.bool_], share: float, tolerances: tuple[float, float]) -> None:
    needed = max(MIN_CAMERAS, int(np.ceil(share * len(inliers))))
    if inliers.sum() < needed:
        raise SimilarityError(
            f"expected at least {needed} of {len(inliers)} cameras to agree within {tolerances[0]:.3g} m and "
            f"{np.rad2deg(tolerances[1]):.2g} degrees, got {int(inliers.sum())}; check the stamps, the mounting pose of the camera "
            "and that the motion-capture subject is the car, or allow larger tolerances"
        )


def _refuse_degenerate(positions: Array, which: str) -> None:
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if spread[0] < 1e-9 or spread[1] < _LINE_RATIO * spread[0]:
        shape = "at one place" if spread[0] < 1e-9 else "on one line"
        raise SimilarityError(
            f"expected cameras spread over an area, got {which} {len(positions)} {shape}: the rotation about it would hang on "
            "a few millimetres; take frames of a drive with curves"
        )
