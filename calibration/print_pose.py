"""Pose of a print in one photograph, from the corners of its markers, and its true size where a card of known size hangs in its plane.

A single photograph gives the pose in units of the size that was to be printed: a print twice as large, twice as far away, looks the
same. What the corners do not determine is refused, by the covariance of the fit: two tilts that look alike, too small a print, a bent one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import Array, Pinhole, invert_transform, make_transform
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.print_markers import LEAST_MARKERS, Marker

# Corners of one marker share the errors of its edges: standard deviations are those of independent errors, times this.
CORRELATED = 2.0
LEAST_NOISE_PX = 0.05
MOST_ANGLE_RAD, MOST_SHARE = np.radians(0.5), 0.005
_AMBIGUOUS = 25.0  # difference of the sums of squares of two tilts, in variances
_MOST_RMS_PX, _MOST_RMS_SHARE = 0.6, 0.004  # of the extent of the markers in the picture
_OUTLIER, _LEAST_OUTLIER_PX = 4.0, 1.0
_MOST_DROPPED = 0.34
_LEAST_ASPECT, _BETTER = 0.002, 0.7  # a ratio of width and height is believed where it explains the errors
_MOST_CARD_TILT_RAD = np.radians(4.0)


@dataclass(frozen=True, eq=False)
class PrintPose:
    """A print in a photograph. Lengths are in units of the nominal size: times the print's true scale, they are metres.

    Attributes:
        T_camera_from_face: Pose ``[4, 4]`` of the print.
        seen: Numbers of the markers that were used.
        dropped: Numbers of those that were found, and left out, because they do not lie where the others put them.
        rms_px: Root mean square distance of the corners from their projections [px].
        rms_m: The same in the print's plane.
        angle_sd_rad: Standard deviation of the direction that the print faces [rad].
        distance_sd: Standard deviation of the distance, as a share of it.
        aspect: Width over height, as a share of the nominal ratio; 1 where the photograph does not tell it from 1.
        card_scale: True size over nominal size, by the card; None without a card.
        card_scale_sd: Its standard deviation.
    """

    T_camera_from_face: Array
    seen: tuple[int, ...]
    dropped: tuple[int, ...]
    rms_px: float
    rms_m: float
    angle_sd_rad: float
    distance_sd: float
    aspect: float
    card_scale: float | None = None
    card_scale_sd: float = 0.0

    @property
    def view_angle_rad(self) -> float:
        """Angle between the print's normal and the direction to the camera [rad]."""
        to_camera = invert_transform(self.T_camera_from_face)[:3, 3]
        return float(np.arccos(np.clip(to_camera[0] / np.linalg.norm(to_camera), -1.0, 1.0)))


def fit_print(
    markers: Mapping[int, Marker],
    corners_m: Mapping[int, Array],
    pinhole: Pinhole,
    card: tuple[Mapping[int, Marker], Mapping[int, Array]] | None = None,
) -> PrintPose:
    """Fit the pose of a flat print.

    Args:
        markers: Markers in the photograph by number.
        corners_m: Nominal corners ``[4, 3]`` of all markers of the print [m].
        pinhole: Intrinsics of the undistorted photograph.
        card: Markers in the photograph, and true corners [m], of a card in the plane of the print.

    Raises:
        DegenerateDataError: Too few markers, or they do not determine the pose.
        PoorFitError: The markers do not lie in one plane as printed, or before the camera.
    """
    if len(markers) < LEAST_MARKERS:
        raise DegenerateDataError(
            f"expected at least {LEAST_MARKERS} of the print's {len(corners_m)} markers, got {len(markers)}; "
            "uncover the print, go nearer, or photograph it from further in front"
        )
    kept, dropped = dict(markers), []
    while True:
        T = _without_doubt(kept, corners_m, pinhole)
        fit = _fit(_rigid(kept, corners_m, pinhole), np.concatenate([_vector(T), [0.0]]))
        worst = _worst(fit.errors_px, list(kept))
        if worst is None:
            break
        dropped.append(worst)
        del kept[worst]
        if len(kept) < LEAST_MARKERS or len(dropped) > _MOST_DROPPED * len(markers):
            raise PoorFitError(
                f"expected markers in one plane, as printed, got {len(dropped)} of {len(markers)} elsewhere; is the print bent, is this its "
                ".print.json, and the right lens?"
            )
    return _result(fit, kept, tuple(dropped), corners_m, pinhole, card)


@dataclass(frozen=True, eq=False)
class _Fit:
    values: Array
    covariance: Array
    errors_px: Array  # [N, 4, 2]

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(self.errors_px**2) * 2.0))

    @property
    def cost(self) -> float:
        return float(np.sum(self.errors_px**2))


def _fit(errors: Callable[[Array], Array], start: Array) -> _Fit:
    shape = errors(start).shape
    found = least_squares(lambda p: errors(p).ravel(), start, x_scale="jac", method="lm")
    free = max(1, found.fun.size - found.x.size)
    variance = max(float(found.fun @ found.fun) / free, LEAST_NOISE_PX**2) * CORRELATED**2
    return _Fit(found.x, variance * np.linalg.pinv(found.jac.T @ found.jac), found.fun.reshape(shape))


def _rigid(
    markers: Mapping[int, Marker], corners_m: Mapping[int, Array], pinhole: Pinhole
) -> Callable[[Array], Array]:
    """Errors ``[N, 4, 2]`` [px] over rotation vector, translation, growth of the black, and, if given, the logarithm of the aspect."""
    points, pixels = _arrays(markers, corners_m)
    middles = points.mean(axis=1, keepdims=True)

    def errors(p: Array) -> Array:
        grown = middles + (1.0 + p[6]) * (points - middles)
        if len(p) > 7:
            grown = grown * np.exp([0.0, 0.5 * p[7], -0.5 * p[7]])
        return pinhole.project(_moved(p, grown)) - pixels

    return errors


def _with_card(
    markers: Mapping[int, Marker],
    corners_m: Mapping[int, Array],
    pinhole: Pinhole,
    card: tuple[Mapping[int, Marker], Mapping[int, Array]],
    aspect: float,
) -> Callable[[Array], Array]:
    """As `_rigid`, at a given aspect, with a card in the print's plane: its place y, z, its turn, the logarithm of its size in nominal units, its growth."""
    own = _rigid(markers, corners_m, pinhole)
    points, pixels = _arrays(*card)
    middles = points.mean(axis=1, keepdims=True)

    def errors(p: Array) -> Array:
        y, z, turn, log_size, growth = p[7:]
        c, s = np.cos(turn), np.sin(turn)
        grown = np.exp(log_size) * (middles + (1.0 + growth) * (points - middles))
        laid = grown @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T + [0.0, y, z]
        return np.concatenate([own(np.append(p[:7], aspect)), pinhole.project(_moved(p, laid)) - pixels])

    return errors


def _result(
    fit: _Fit,
    markers: Mapping[int, Marker],
    dropped: tuple[int, ...],
    corners_m: Mapping[int, Array],
    pinhole: Pinhole,
    card: tuple[Mapping[int, Marker], Mapping[int, Array]] | None,
) -> PrintPose:
    extent_px = float(np.ptp(np.concatenate([each.pixels for each in markers.values()]), axis=0).max())
    fit, aspect = _with_aspect(fit, markers, corners_m, pinhole)
    _require_flat(fit, extent_px)
    scale, scale_sd = None, 0.0
    if card is not None:
        fit, scale, scale_sd = _carded(fit, markers, corners_m, pinhole, card)
        _require_flat(fit, extent_px)
    T = _transform(fit.values)
    distance = float(np.linalg.norm(T[:3, 3]))
    along = T[:3, 3] / distance
    angle_sd = float(np.sqrt(np.linalg.eigvalsh(fit.covariance[:3, :3])[-1]))
    distance_sd = float(np.sqrt(along @ fit.covariance[3:6, 3:6] @ along)) / distance
    if angle_sd > MOST_ANGLE_RAD or max(distance_sd, scale_sd) > MOST_SHARE:
        raise DegenerateDataError(
            f"expected markers that give the direction within {np.degrees(MOST_ANGLE_RAD):.1f} degrees and lengths within {100 * MOST_SHARE:.1f} %, got "
            f"{np.degrees(angle_sd):.2f} degrees and {100 * max(distance_sd, scale_sd):.2f} % from {len(markers)} markers; go nearer, or uncover more of them"
        )
    return PrintPose(
        T,
        tuple(markers),
        dropped,
        fit.rms_px,
        fit.rms_px * distance / pinhole.fx,
        angle_sd,
        distance_sd,
        aspect,
        scale,
        scale_sd,
    )


def _require_flat(fit: _Fit, extent_px: float) -> None:
    most_px = max(_MOST_RMS_PX, _MOST_RMS_SHARE * extent_px)
    if fit.rms_px > most_px:
        raise PoorFitError(
            f"expected markers in one plane within {most_px:.1f} px, got {fit.rms_px:.1f} px; is the print bent, is this its .print.json, and the "
            "right lens?"
        )


def _carded(
    fit: _Fit,
    markers: Mapping[int, Marker],
    corners_m: Mapping[int, Array],
    pinhole: Pinhole,
    card: tuple[Mapping[int, Marker], Mapping[int, Array]],
) -> tuple[_Fit, float, float]:
    if len(card[0]) < LEAST_MARKERS:
        raise DegenerateDataError(
            f"expected at least {LEAST_MARKERS} markers of the card, got {len(card[0])}; uncover it, or go nearer"
        )
    own = _fit(_rigid(*card, pinhole), np.concatenate([_vector(some_pose(*card, pinhole)), [0.0]]))
    T, T_card = _transform(fit.values), _transform(own.values)
    tilt_rad = float(np.arccos(np.clip(T[:3, 0] @ T_card[:3, 0], -1.0, 1.0)))
    tilt_sd = float(np.sqrt(np.linalg.eigvalsh(own.covariance[:3, :3])[-1]))
    if tilt_rad > max(_MOST_CARD_TILT_RAD, 4.0 * tilt_sd):
        raise PoorFitError(
            f"expected the card in the plane of the print, got an angle of {np.degrees(tilt_rad):.0f} degrees between them; fix it flat beside the print"
        )
    # The card's middle meets the print's plane where its ray does.
    T_face_from_camera = invert_transform(T)
    ray = T_face_from_camera[:3, :3] @ T_card[:3, 3]
    reach = -T_face_from_camera[0, 3] / ray[0]
    y, z = (T_face_from_camera[:3, 3] + reach * ray)[1:]
    turned = T_face_from_camera[:3, :3] @ T_card[:3, 1]
    start = [y, z, np.arctan2(turned[2], turned[1]), np.log(reach), 0.0]
    joint = _fit(
        _with_card(markers, corners_m, pinhole, card, fit.values[7]), np.concatenate([fit.values[:7], start])
    )
    return joint, float(np.exp(-joint.values[10])), float(np.sqrt(joint.covariance[10, 10]))


def _with_aspect(
    fit: _Fit, markers: Mapping[int, Marker], corners_m: Mapping[int, Array], pinhole: Pinhole
) -> tuple[_Fit, float]:
    """The fit with a free width over height, and this ratio over the nominal one, where the photograph tells it from 1."""
    free = _fit(_rigid(markers, corners_m, pinhole), np.concatenate([fit.values[:7], [0.0]]))
    found, sd = float(free.values[7]), float(np.sqrt(free.covariance[7, 7]))
    if abs(found) > max(3.0 * sd, _LEAST_ASPECT) and free.rms_px < _BETTER * fit.rms_px:
        return free, float(np.exp(found))
    return _Fit(np.append(fit.values, 0.0), fit.covariance, fit.errors_px), 1.0


def _without_doubt(
    markers: Mapping[int, Marker], corners_m: Mapping[int, Array], pinhole: Pinhole, alone: bool = True
) -> Array:
    """The pose ``[4, 4]`` that explains the corners best; of two that do so about equally well, an error, or the better one."""
    points, pixels = _arrays(markers, corners_m)
    count, turns, moves, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(points.reshape(-1, 3)[:, [1, 2, 0]]),
        np.ascontiguousarray(pixels.reshape(-1, 2)),
        pinhole.matrix,
        None,
        flags=cv2.SOLVEPNP_IPPE,
    )
    starts = [
        make_transform(cv2.Rodrigues(turn)[0][:, [2, 0, 1]], move.ravel())
        for turn, move in zip(turns, moves, strict=True)
        if np.isfinite(turn).all() and np.isfinite(move).all()
    ]
    errors = _rigid(markers, corners_m, pinhole)
    fits = [_fit(errors, np.concatenate([_vector(T), [0.0]])) for T in starts[:count]]
    fits = sorted((each for each in fits if each.values[5] > 0.0), key=lambda each: each.cost)
    if not fits:
        raise PoorFitError(
            f"expected the corners of {len(markers)} markers that some pose explains, got none; is this its .print.json, and the right lens?"
        )
    best = _transform(fits[0].values)
    for other in fits[1:] if alone else ():
        apart = float(rotation_angles((best[:3, :3].T @ _transform(other.values)[:3, :3])[None])[0])
        noise = max(fits[0].cost / fits[0].errors_px.size, LEAST_NOISE_PX**2) * CORRELATED**2
        if apart > MOST_ANGLE_RAD and other.cost - fits[0].cost < _AMBIGUOUS * noise:
            raise DegenerateDataError(
                f"expected one pose, got two that look alike, {np.degrees(apart):.0f} degrees apart; go nearer, or photograph it from the side"
            )
    return best


def some_pose(markers: Mapping[int, Marker], corners_m: Mapping[int, Array], pinhole: Pinhole) -> Array:
    """The pose ``[4, 4]`` that explains the corners best, in nominal units, whatever else explains them."""
    return _without_doubt(markers, corners_m, pinhole, False)


def _worst(errors_px: Array, numbers: list[int]) -> int | None:
    """The marker that lies farthest from where the others put it; None if all lie well."""
    each = np.sqrt(np.mean(np.sum(errors_px**2, axis=2), axis=1))
    index = int(each.argmax())
    limit = max(_OUTLIER * float(np.median(each)), _LEAST_OUTLIER_PX)
    return numbers[index] if each[index] > limit else None


def _arrays(markers: Mapping[int, Marker], corners_m: Mapping[int, Array]) -> tuple[Array, Array]:
    points = np.stack([corners_m[number] for number in markers])
    return points, np.stack([each.pixels for each in markers.values()])


def _moved(p: Array, points: Array) -> Array:
    return np.asarray(points @ cv2.Rodrigues(p[:3])[0].T + p[3:6])


def _vector(T: Array) -> Array:
    return np.concatenate([cv2.Rodrigues(np.ascontiguousarray(T[:3, :3]))[0].ravel(), T[:3, 3]])


def _transform(p: Array) -> Array:
    return make_transform(cv2.Rodrigues(p[:3])[0], p[3:6])
