"""Pose of a print in one photograph, from the corners of its markers, and its true size where a card of known size hangs in its plane.

A single photograph gives the pose in units of the size that was to be printed: a print twice as large, twice as far away, looks the
same. What the corners do not determine is refused, by the covariance of the fit: two tilts that look alike, too small a print, a bent one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import Array, Pinhole, invert_transform, make_transform
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.print_markers import LEAST_MARKERS
from calibration.print_model import (
    ASPECT,
    BEND,
    BENT,
    CORRELATED,
    COUNT,
    LEAST_NOISE_PX,
    RIGID,
    Errors,
    LaidPrint,
    PrintFit,
    bend_m,
    corner_errors,
    fit_parameters,
    half_side,
    moved,
    parameters,
    shift_lengths_m,
)

Seen = tuple[Mapping[int, Array], Mapping[int, Array]]
"""Corners ``[4, 2]`` of markers in the photograph [px], and ``[4, 3]`` of all markers [m], by number."""

MOST_ANGLE_RAD, MOST_SHARE = np.radians(0.5), 0.005
_AMBIGUOUS = 25.0  # difference of the sums of squares of two tilts, in variances
_MOST_RMS_PX, _MOST_RMS_SHARE = 0.6, 0.004  # of the extent of the markers in the picture
_OUTLIER, _LEAST_OUTLIER_PX = 4.0, 1.0
_MOST_DROPPED = 0.34
_LEAST_ASPECT, _BETTER = 0.002, 0.7  # a ratio of width and height is believed where it explains the errors
_MOST_CARD_TILT_RAD = np.radians(4.0)
_MOST_BEND = 0.06  # of half a side: beyond, a bend is no parabola


@dataclass(frozen=True, eq=False)
class PrintPose:
    """A print in a photograph. Lengths are in units of the nominal size: times the print's true scale, they are metres.

    Attributes:
        laid: Where its points are, with its aspect and bend.
        seen: Numbers of the markers that were used.
        dropped: Numbers of those that were found, and left out, because they do not lie where the others put them.
        off_m: Distance of each marker that was found from its place in the print's plane, by number.
        rms_px: Root mean square distance of the corners from their projections [px].
        rms_m: The same in the print's plane.
        bend_m: Root mean square distance of the markers from the middle plane, as far as the photograph shows a bend.
        bend_sd_m: Standard deviation of the bend.
        angle_sd_rad: Standard deviation of the direction that the print faces [rad].
        distance_sd: Standard deviation of the distance, as a share of it.
        card_scale: True size over nominal size, by the card; None without a card.
        card_scale_sd: Standard deviation of the card's scale.
    """

    laid: LaidPrint
    seen: tuple[int, ...]
    dropped: tuple[int, ...]
    off_m: Mapping[int, float]
    rms_px: float
    rms_m: float
    bend_m: float
    bend_sd_m: float
    angle_sd_rad: float
    distance_sd: float
    card_scale: float | None = None
    card_scale_sd: float = 0.0

    @property
    def T_camera_from_face(self) -> Array:
        """Pose ``[4, 4]`` of the middle plane."""
        return self.laid.T_camera_from_face

    @property
    def aspect(self) -> float:
        """Width over height, as a share of the nominal ratio; 1 where the photograph does not tell it from 1."""
        return float(np.exp(self.laid.log_aspect))

    @property
    def view_angle_rad(self) -> float:
        """Angle between the print's normal and the direction to the camera [rad]."""
        to_camera = invert_transform(self.T_camera_from_face)[:3, 3]
        return float(np.arccos(np.clip(to_camera[0] / np.linalg.norm(to_camera), -1.0, 1.0)))


def fit_print(
    markers: Mapping[int, Array], corners_m: Mapping[int, Array], pinhole: Pinhole, card: Seen | None = None
) -> PrintPose:
    """Fit the pose of a nearly flat print.

    Args:
        markers: Corners ``[4, 2]`` of the markers in the photograph by number [px].
        corners_m: Nominal corners ``[4, 3]`` of all markers of the print [m].
        pinhole: Intrinsics of the undistorted photograph.
        card: A card of true size in the plane of the print.

    Raises:
        DegenerateDataError: Too few markers, or they do not determine the pose.
        PoorFitError: The markers do not lie as printed, or the print is bent.
    """
    _require_markers(len(markers), len(corners_m), "print")
    kept, dropped = dict(markers), []
    while True:
        fit = _only_pose((kept, corners_m), pinhole)
        worst = _worst(fit.errors_px, list(kept))
        if worst is None:
            break
        dropped.append(worst)
        del kept[worst]
        if len(kept) < LEAST_MARKERS or len(dropped) > _MOST_DROPPED * len(markers):
            raise PoorFitError(
                f"expected markers in one plane, as printed, got {len(dropped)} of {len(markers)} elsewhere; is the print bent, is a part of it "
                "glued off its place, is this its .print.json, and the right lens?"
            )
    fit = _with_aspect(fit, (kept, corners_m), pinhole)
    extent_px = float(np.ptp(np.concatenate(list(kept.values())), axis=0).max())
    bend, bend_sd = _require_flat(fit, extent_px, (kept, corners_m), pinhole)
    scale, scale_sd = None, 0.0
    if card is not None:
        fit, scale, scale_sd = _carded(fit, (kept, corners_m), card, pinhole)
        _require_flat(fit, extent_px, (kept, corners_m), pinhole)
    distance_sd = _require_sure(fit, scale_sd, len(kept))
    rms_m = fit.rms_px * float(np.linalg.norm(fit.values[3:6])) / pinhole.fx
    return PrintPose(
        LaidPrint(fit.transform, float(fit.values[ASPECT]), fit.values[BEND], half_side(corners_m)),
        tuple(kept),
        tuple(dropped),
        _off_m(fit, (markers, corners_m), pinhole),
        fit.rms_px,
        rms_m,
        bend,
        bend_sd,
        fit.angle_sd_rad,
        distance_sd,
        scale,
        scale_sd,
    )


def some_pose(markers: Mapping[int, Array], corners_m: Mapping[int, Array], pinhole: Pinhole) -> Array:
    """The pose ``[4, 4]`` that explains the corners best, in nominal units, whatever else explains them."""
    return _fits((markers, corners_m), pinhole)[0].transform


def _require_markers(seen: int, printed: int, what: str) -> None:
    if seen < LEAST_MARKERS:
        raise DegenerateDataError(
            f"expected at least {LEAST_MARKERS} of the {what}'s {printed} markers, got {seen}; uncover it, go nearer, or photograph it from further in front"
        )


def _fits(seen: Seen, pinhole: Pinhole) -> list[PrintFit]:
    """All poses that explain the corners, the best first."""
    markers, corners_m = seen
    points = np.concatenate([corners_m[number] for number in markers])
    pixels = np.concatenate(list(markers.values()))
    flat = np.ascontiguousarray(points[:, [1, 2, 0]])
    _, turns, moves, _ = cv2.solvePnPGeneric(flat, pixels, pinhole.matrix, None, flags=cv2.SOLVEPNP_IPPE)
    starts = [
        make_transform(cv2.Rodrigues(turn)[0][:, [2, 0, 1]], move.ravel())
        for turn, move in zip(turns, moves, strict=True)
        if np.isfinite(turn).all() and np.isfinite(move).all()
    ]
    errors, half_m = corner_errors(markers, corners_m, pinhole), half_side(corners_m)
    flat_fits = [fit_parameters(errors, parameters(T), RIGID, half_m) for T in starts]
    found = [fit_parameters(errors, each.values, BENT, half_m) for each in flat_fits if each.values[5] > 0.0]
    if not found:
        raise PoorFitError(
            f"expected the corners of {len(markers)} markers that some pose explains, got none; is this its .print.json, and the right lens?"
        )
    return sorted(found, key=lambda each: each.cost)


def _only_pose(seen: Seen, pinhole: Pinhole) -> PrintFit:
    """The pose that explains the corners; an error if two do so about equally well."""
    best, *others = _fits(seen, pinhole)
    for other in others:
        apart = float(rotation_angles((best.transform[:3, :3].T @ other.transform[:3, :3])[None])[0])
        noise = max(best.cost / best.errors_px.size, LEAST_NOISE_PX**2) * CORRELATED**2
        if apart > MOST_ANGLE_RAD and other.cost - best.cost < _AMBIGUOUS * noise:
            raise DegenerateDataError(
                f"expected one pose, got two that look alike, {np.degrees(apart):.0f} degrees apart; go nearer, or photograph it from the side"
            )
    return best


def _worst(errors_px: Array, numbers: list[int]) -> int | None:
    """The marker that lies farthest from where the others put it; None if all lie well."""
    each = np.sqrt(np.mean(np.sum(errors_px**2, axis=2), axis=1))
    index = int(each.argmax())
    limit = max(_OUTLIER * float(np.median(each)), _LEAST_OUTLIER_PX)
    return numbers[index] if each[index] > limit else None


def _with_aspect(fit: PrintFit, seen: Seen, pinhole: Pinhole) -> PrintFit:
    """The fit with a free width over height, where the photograph tells its ratio from the nominal one."""
    errors, half_m = corner_errors(*seen, pinhole), half_side(seen[1])
    free = fit_parameters(errors, fit.values, (*BENT, ASPECT), half_m)
    believed = abs(free.values[ASPECT]) > max(3.0 * free.sd(ASPECT), _LEAST_ASPECT)
    return free if believed and free.rms_px < _BETTER * fit.rms_px else fit


def _off_m(fit: PrintFit, seen: Seen, pinhole: Pinhole) -> dict[int, float]:
    markers, corners_m = seen

    def errors(shift_m: Array) -> Array:
        shifted = {number: corners + shift_m for number, corners in corners_m.items()}
        return corner_errors(markers, shifted, pinhole)(fit.values[:COUNT])

    return shift_lengths_m(errors, list(markers))


def _require_flat(fit: PrintFit, extent_px: float, seen: Seen, pinhole: Pinhole) -> tuple[float, float]:
    """Root mean square bend at the markers and its standard deviation, in nominal metres; an error if it is too large."""
    most_px = max(_MOST_RMS_PX, _MOST_RMS_SHARE * extent_px)
    markers, corners_m = seen
    half_m = half_side(corners_m)
    at = np.concatenate([corners_m[number] for number in markers]) / half_m
    terms = np.stack([bend_m(row, at) for row in np.eye(3)], axis=-1)
    off, off_sd = (float(np.sqrt(np.mean(square))) for square in (
        (terms @ fit.values[BEND]) ** 2, np.einsum("ni,ij,nj->n", terms, fit.covariance[BEND, BEND], terms)
    ))  # fmt: skip
    bend = float(np.abs(fit.values[BEND]).max())
    if fit.rms_px > most_px or bend > _MOST_BEND * half_m:
        off_m = _off_m(fit, seen, pinhole)
        worst = max(off_m, key=off_m.__getitem__)
        raise PoorFitError(
            f"expected markers in one plane within {most_px:.1f} px and a bend below {100 * _MOST_BEND:.0f} % of half a side, got {fit.rms_px:.1f} px and "
            f"{100 * bend / half_m:.0f} %, the farthest, marker {worst}, {1000 * off_m[worst]:.1f} mm off; is the print bent, is a part of it glued off its "
            "place, is this its .print.json, and the right lens?"
        )
    return off, off_sd


def _require_sure(fit: PrintFit, scale_sd: float, count: int) -> float:
    """The standard deviation of the distance, as a share of it; an error if direction or lengths are too unsure."""
    move = fit.values[3:6]
    distance_sd = float(np.sqrt(move @ fit.covariance[3:6, 3:6] @ move) / (move @ move))
    if fit.angle_sd_rad > MOST_ANGLE_RAD or max(distance_sd, scale_sd) > MOST_SHARE:
        raise DegenerateDataError(
            f"expected markers that give the direction within {np.degrees(MOST_ANGLE_RAD):.1f} degrees and lengths within {100 * MOST_SHARE:.1f} %, got "
            f"{np.degrees(fit.angle_sd_rad):.2f} degrees and {100 * max(distance_sd, scale_sd):.2f} % from {count} markers; go nearer, or uncover more of them"
        )
    return distance_sd


def _carded(fit: PrintFit, seen: Seen, card: Seen, pinhole: Pinhole) -> tuple[PrintFit, float, float]:
    _require_markers(len(card[0]), len(card[1]), "card")
    half_m = half_side(seen[1])
    own = fit_parameters(corner_errors(*card, pinhole), parameters(some_pose(*card, pinhole)), RIGID, half_m)
    T, T_card = fit.transform, own.transform
    tilt_rad = float(np.arccos(np.clip(T[:3, 0] @ T_card[:3, 0], -1.0, 1.0)))
    if tilt_rad > max(_MOST_CARD_TILT_RAD, 4.0 * own.angle_sd_rad):
        raise PoorFitError(
            f"expected the card in the plane of the print, got an angle of {np.degrees(tilt_rad):.0f} degrees between them; fix it flat beside the print"
        )
    # The card's middle meets the print's plane where its ray does.
    T_face_from_camera = invert_transform(T)
    ray = T_face_from_camera[:3, :3] @ T_card[:3, 3]
    reach = -T_face_from_camera[0, 3] / ray[0]
    y, z = (T_face_from_camera[:3, 3] + reach * ray)[1:]
    turned = T_face_from_camera[:3, :3] @ T_card[:3, 1]
    start = np.concatenate([fit.values, [y, z, np.arctan2(turned[2], turned[1]), np.log(reach), 0.0]])
    free = (*BENT, *range(COUNT, COUNT + 5))
    joint = fit_parameters(_with_card(seen, card, pinhole), start, free, half_m)
    return joint, float(np.exp(-joint.values[COUNT + 3])), joint.sd(COUNT + 3)


def _with_card(seen: Seen, card: Seen, pinhole: Pinhole) -> Errors:
    """Errors with a card in the print's plane, over five more parameters: its place y, z, its turn, the logarithm of its size, its growth."""
    own = corner_errors(*seen, pinhole)
    points = np.stack([card[1][number] for number in card[0]])
    pixels = np.stack(list(card[0].values()))
    middles = points.mean(axis=1, keepdims=True)

    def errors(p: Array) -> Array:
        y, z, turn, log_size, growth = p[COUNT:]
        c, s = np.cos(turn), np.sin(turn)
        grown = np.exp(log_size) * (middles + (1.0 + growth) * (points - middles))
        laid = grown @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T + [0.0, y, z]
        return np.concatenate([own(p), pinhole.project(moved(p, laid)) - pixels])

    return errors
