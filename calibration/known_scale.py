"""Gives a model of photographs its metres: from one known length, from printed markers, or from known camera positions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.aruco import marker_dictionary
from advnerf_core.data.similarity import Similarity, fit_positions
from advnerf_core.geometry import Array, Pinhole, invert_transform
from calibration.photo_model import Model, ReconstructionError, Registered
from calibration.world_axes import Ground, cameras_up

# An undistorted image ``[H, W, 3]`` with its pinhole and ``T_world_from_camera``.
View = tuple[NDArray[np.uint8], Pinhole, Array]
# A marker's corner farther from its projections is dropped [px].
_MAX_CORNER_ERROR_PX = 3.0
# Rays of a corner that meet at a smaller angle do not fix its distance [rad].
_MIN_RAY_ANGLE_RAD = np.radians(2.0)
# Sides of markers that differ more are not all of one size.
_MAX_SIDE_SPREAD = 0.1
# Known positions that fit worse than this share of their extent belong to something else.
_MAX_POSITION_SHARE = 0.1
# Positions are wrong if others fit this much better, and the worst is off by more than a share of their extent.
_MUCH_BETTER, _MIN_TO_COMPARE, _LEAST_SHARE = 4.0, 8, 0.005
# Up of the cameras in a world with z up; one below this is upside down.
_UPSIDE_DOWN = -0.5
_SHOWN = 4


def length_scale(
    model: Model, points_by_id: Mapping[int, Array], one: str, other: str, length_m: float
) -> float:
    """Metres per unit of a model, from one known length.

    Args:
        points_by_id: Points ``[3]`` by the number that COLMAP shows.
        one: Name of an image, for the position of its camera, or the number of a point in COLMAP.
        length_m: Distance between both [m].

    Raises:
        ReconstructionError: An end is not in the model, or both are at one place.
    """
    distance = float(np.linalg.norm(_end(model, points_by_id, one) - _end(model, points_by_id, other)))
    if not (length_m > 0.0 and distance > 0.0):
        raise ReconstructionError(
            f"expected a length above 0 m between two different places, got {length_m} m from {one} to {other}; correct --length"
        )
    return length_m / distance


def _of_name(model: Model, name: str) -> list[Registered]:
    """Images of a name; of one that no image has as a whole, those that end with it behind a folder."""
    whole = [each for each in model.images if each.name == name]
    return whole or [each for each in model.images if each.name.endswith(f"/{name}")]


def _end(model: Model, points_by_id: Mapping[int, Array], name: str) -> Array:
    images = _of_name(model, name)
    if len(images) == 1:
        return np.asarray(images[0].T_world_from_camera[:3, 3])
    if name.isdigit() and int(name) in points_by_id:
        return points_by_id[int(name)]
    names = ", ".join(each.name for each in (images or model.images)[:_SHOWN])
    raise ReconstructionError(
        f"expected --length to name one image with a pose ({names}, ...) or the number of a point in COLMAP, got {name}"
    )


@dataclass(frozen=True)
class PositionFit:
    """A model placed by known positions of its cameras.

    Attributes:
        similarity: From the model to the world of the positions.
        images: Number of images that it was fitted to.
        rms_m: Root mean square distance of the cameras from their positions [m].
        worst_m: Largest such distance [m].
        worst: Image with this distance.
        not_used: The first positions that name no single image, and why, as text; empty if all do.
        on_line: Whether the positions are on one line, so that up comes from the cameras or the ground.
    """

    similarity: Similarity
    images: int
    rms_m: float
    worst_m: float
    worst: str
    not_used: str
    on_line: bool


def fit_known_positions(model: Model, positions_m: Mapping[str, Array], ground: Ground | None) -> PositionFit:
    """Place a model by the positions ``[3]`` of cameras by image name, in a world with z up.

    Args:
        ground: Ground of the model; it determines the up direction if the positions are on one line.

    Raises:
        ReconstructionError: Two positions are of one image, or the positions do not fit the model.
        SimilarityError: They do not fix scale and direction.
    """
    found = {name: _of_name(model, name) for name in positions_m}
    row_of = _one_row_each({name: each[0] for name, each in found.items() if len(each) == 1})
    not_used = _not_used(found)
    if len(row_of) < 2:
        raise ReconstructionError(
            f"expected positions of at least 2 of the model's images, got {len(row_of)}{not_used and f' ({not_used})'}; "
            f"write the names as COLMAP does: {', '.join(each.name for each in model.images[:_SHOWN])}"
        )
    images = [found[name][0] for name in row_of.values()]
    source = np.stack([each.T_world_from_camera[:3, 3] for each in images])
    target = np.stack([np.asarray(positions_m[name], np.float64) for name in row_of.values()])
    up = cameras_up(model.poses) if ground is None else ground.up
    similarity, on_line = fit_positions(source, target, up)
    errors = np.linalg.norm(similarity.points(source) - target, axis=1)
    rms, worst = _rms(errors), int(np.argmax(errors))
    spread = float(np.linalg.norm(np.ptp(target, axis=0)))
    compared = len(images) >= _MIN_TO_COMPARE and errors[worst] >= _LEAST_SHARE * spread
    if compared:
        _refuse_other_rows(source, target, up, rms)
    if rms > _MAX_POSITION_SHARE * spread:
        raise ReconstructionError(
            f"expected positions that fit the model, got distances of {rms:.3g} m (rms) over {spread:.3g} m, the largest "
            f"{errors[worst]:.3g} m at {images[worst].name}; correct the file: metres, x, y and z up in a right-handed frame"
        )
    if (similarity.T_target_from_source[:3, :3] @ up)[2] < _UPSIDE_DOWN:
        raise ReconstructionError(
            "expected positions in a right-handed frame with z up, got ones by which the cameras stand on their heads: are x and y exchanged "
            "(north before east), or is one of them reversed? Correct the file"
        )
    if compared:
        _refuse_outlier(source, target, up, rms, [each.name for each in images], worst)
    return PositionFit(
        similarity, len(images), rms, float(errors[worst]), images[worst].name, not_used, on_line
    )


def _one_row_each(image_of: Mapping[str, Registered]) -> dict[str, str]:
    """Names of the positions by the image's own name; an error for a second position of one image."""
    row_of: dict[str, str] = {}
    for row, image in image_of.items():
        if (earlier := row_of.setdefault(image.name, row)) != row:
            raise ReconstructionError(
                f"expected one position for each image, got those of {earlier} and {row}, which are both {image.name}; remove one row"
            )
    return row_of


def _not_used(found: Mapping[str, list[Registered]]) -> str:
    """The first positions that name no image of the model or several, as text; empty for none."""
    others = [
        f"{name}, which is {' and '.join(each.name for each in images[:_SHOWN])}"
        if images
        else f"{name}, which is no image with a pose"
        for name, images in found.items()
        if len(images) != 1
    ]
    more = "; ..." if len(others) > _SHOWN else ""
    return f"not used: {'; '.join(others[:_SHOWN])}{more}" if others else ""


def _refuse_outlier(
    source: Array, target: Array, up: Array, rms_m: float, names: list[str], worst: int
) -> None:
    """Refuse a position ``[3]`` without which the others fit much better: a wrong row would tilt and scale the whole model."""
    others = np.arange(len(names)) != worst
    similarity, _ = fit_positions(source[others], target[others], up)
    distances = np.linalg.norm(similarity.points(source) - target, axis=1)
    without_m = _rms(distances[others])
    if without_m * _MUCH_BETTER < rms_m:
        raise ReconstructionError(
            f"expected positions that fit each other, got one of {names[worst]} that is {distances[worst]:.3g} m away from where the others, which fit "
            f"to {without_m:.2g} m (rms), put it; correct its row, or remove it"
        )


def _refuse_other_rows(source: Array, target: Array, up: Array, rms_m: float) -> None:
    """Refuse positions of which each belongs to the row before or after it: a whole track a step off fits nearly as well."""
    for places, positions, said in (
        (source[1:], target[:-1], "before"),
        (source[:-1], target[1:], "after"),
    ):
        similarity, _ = fit_positions(places, positions, up)
        moved_m = _rms(np.linalg.norm(similarity.points(places) - positions, axis=1))
        if moved_m * _MUCH_BETTER < rms_m:
            raise ReconstructionError(
                f"expected the position of each image in its row, got positions that fit to {rms_m:.2g} m (rms), and to {moved_m:.2g} m if each image "
                f"takes that of the row {said} it; correct the names"
            )


def _rms(distances_m: Array) -> float:
    return float(np.sqrt(np.mean(distances_m**2)))


@dataclass(frozen=True)
class MarkerFit:
    """The scale that printed markers give.

    Attributes:
        scale: Metres per unit of the model.
        markers: Number of markers that were measured.
        spread: Standard deviation of the sides over their mean.
    """

    scale: float
    markers: int
    spread: float


def marker_scale(views: Iterable[View], side_m: float, dictionary: str) -> MarkerFit:
    """Metres per unit of a model, from square markers that its images show.

    Args:
        side_m: Side of a marker's black square [m].
        dictionary: OpenCV's name of the markers, such as ``DICT_APRILTAG_36h11``.

    Raises:
        ConfigError: No such dictionary.
        ReconstructionError: No marker in two views, or markers of different sizes.
    """
    detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary))
    detector.setDetectorParameters(_subpixel())
    seen: defaultdict[int, list[tuple[Array, Pinhole, Array]]] = defaultdict(list)
    for image, pinhole, T in views:
        corners, numbers, _ = detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        found = [] if numbers is None else [int(number) for number in numbers.ravel()]
        for pixels, number in zip(corners, found, strict=True):
            if found.count(number) == 1:  # two markers with one number are ambiguous
                seen[number].append((pixels.reshape(4, 2).astype(np.float64) + 0.5, pinhole, T))
    sides = [_sides(each) for each in seen.values()]
    measured = np.array([side for side in sides if side is not None]).reshape(-1, 4)
    if not len(measured):
        raise ReconstructionError(
            f"expected a marker of {dictionary} in two images from different places, got none; check --dictionary, or use --length"
        )
    spread = float(measured.std() / measured.mean())
    if spread > _MAX_SIDE_SPREAD:
        raise ReconstructionError(
            f"expected markers of one size, got sides that differ by {100 * spread:.0f} %; cover the others, or use --length"
        )
    return MarkerFit(side_m / float(np.median(measured)), len(measured), spread)


def _subpixel() -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return parameters


def _sides(views: list[tuple[Array, Pinhole, Array]]) -> Array | None:
    """Sides ``[4]`` of one marker, in the model's unit; None if its corners cannot be located."""
    corners = [_triangulated([(pixels[k], pinhole, T) for pixels, pinhole, T in views]) for k in range(4)]
    if any(corner is None for corner in corners):
        return None
    square = np.array(corners)
    return np.asarray(np.linalg.norm(square - np.roll(square, -1, axis=0), axis=1))


def _triangulated(views: list[tuple[Array, Pinhole, Array]]) -> Array | None:
    """Point ``[3]`` nearest to the rays through its pixels; None if they are nearly parallel or do not meet."""
    origins = np.array([T[:3, 3] for _, _, T in views])
    rays = np.array([T[:3, :3] @ _ray(pixel, pinhole) for pixel, pinhole, T in views])
    if len(rays) < 2 or (rays @ rays.T).min() > np.cos(_MIN_RAY_ANGLE_RAD):
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, origins))
    for pixel, pinhole, T in views:
        local = invert_transform(T)[:3] @ np.append(point, 1.0)
        if local[2] <= 0.0 or np.linalg.norm(pinhole.project(local) - pixel) > _MAX_CORNER_ERROR_PX:
            return None
    return np.asarray(point)


def _ray(pixel: Array, pinhole: Pinhole) -> Array:
    direction = np.array([(pixel[0] - pinhole.cx) / pinhole.fx, (pixel[1] - pinhole.cy) / pinhole.fy, 1.0])
    return np.asarray(direction / np.linalg.norm(direction))
