"""Measures a print in a photograph, or in the bag of a drive past it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import AttackFile
from advnerf_core.attack.printing.poster import Printable, PrintError, poster_of
from advnerf_core.attack.printing.record import PrintRecord
from advnerf_core.data.image_files import write_image
from advnerf_core.data.video import thinned
from advnerf_core.files import write_json
from advnerf_core.geometry import Array, invert_transform, planar_pose, transform_points
from advnerf_core.plain import PlainData
from advnerf_core.plugins import unknown
from calibration.degeneracy import DegenerateDataError
from calibration.print_colour import PrintColours, in_picture, picture_points, print_colours
from calibration.print_drive import PrintView, place_print
from calibration.print_markers import SeenTwiceError, find_markers, why_none
from calibration.print_measurement import (
    CARD,
    DISTANCE,
    WIDTH,
    PrintMeasurement,
    of_drive,
    of_photograph,
)
from calibration.print_model import LaidPrint
from calibration.print_pose import PrintPose, fit_print
from calibration.schema import CalibrationError, CameraCalibration, Intrinsics, load_calibration
from nodes.bags.parts import is_bag_file
from nodes.control.pose_buffer import PoseBuffer
from nodes.lab.wizards.bags import CAR, read_frames, read_picture, read_poses
from nodes.lab.wizards.lens import load_lens

Rgb = NDArray[np.uint8]
_MOST_VIEWS = 60
_MOST_GAP_S = 0.15
# Beyond this share of a drive's pictures, a marker that is seen twice is no wrong detection.
_MOST_TWICE = 0.1
# Of a length read from a ruler or tape, as a share.
_RULER_SD = 0.002


@dataclass(frozen=True)
class KnownLength:
    """What is known of a photograph beside its pixels; at most one of the first three, which give its metres.

    Attributes:
        card: Record of a colour chart of true size in the plane of the print; a poster cannot vouch for its own size.
        distance_m: Distance from the lens to the middle of the print [m].
        width_m: Width of the print's picture, by ruler [m].
        car: Pose of the car that took the photograph: x [m], y [m], yaw [rad].
    """

    card: PrintRecord | None = None
    distance_m: float | None = None
    width_m: float | None = None
    car: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        given = [each for each in (self.card, self.distance_m, self.width_m) if each is not None]
        if len(given) > 1:
            raise CalibrationError(
                f"expected one of --card, --distance and --width, got {len(given)}; give the surest"
            )
        if self.card is not None:
            self.card.require("chart")

    def scale_of(self, pose: PrintPose, nominal_m: tuple[float, float]) -> tuple[str, float, float] | None:
        """What gives the size, true over nominal size, and its standard deviation; None where nothing does."""
        if pose.card_scale is not None:
            return CARD, pose.card_scale, pose.card_scale_sd
        if self.distance_m is not None:
            nominal = float(np.linalg.norm(pose.T_camera_from_face[:3, 3]))
            return DISTANCE, self.distance_m / nominal, float(np.hypot(pose.distance_sd, _RULER_SD))
        if self.width_m is not None:
            return WIDTH, self.width_m / (nominal_m[0] * np.sqrt(pose.aspect)), _RULER_SD
        return None


@dataclass(frozen=True, eq=False)
class MeasuredPrint:
    """A measured print, and its picture.

    Attributes:
        colours: The rectified picture; None where the exposure or the view does not show its colours.
        by_car: Whether the driving camera took it, so that the policy sees these colours.
    """

    measurement: PrintMeasurement
    colours: PrintColours | None
    by_car: bool

    @property
    def texture(self) -> Rgb:
        """What a policy sees of the print with its border ``[n, n, 3]``: as the driving camera saw it; of another camera, without its light.

        Raises:
            DegenerateDataError: The colours are unknown.
        """
        if self.colours is None:
            raise DegenerateDataError(
                f"expected colours of the print, to predict what it does: {self.measurement.colours_unknown}"
            )
        return self.colours.seen if self.by_car else self.colours.unlit


def measure(
    source: Path, record: PrintRecord, attack: AttackFile, camera: Path, known: KnownLength
) -> MeasuredPrint:
    """Measure a print in a photograph or in a bag.

    Args:
        source: The photograph, or the bag.
        record: Sizes and markers of the print.
        camera: Lens or camera file; of a bag, and with a pose of the car, a camera file.

    Raises:
        CalibrationError: The source does not determine the print's pose.
        PrintError: The record is of another print.
    """
    sheet = printed_sheet(record, attack)
    # What is no bag is a picture: phones write .heic, and some have no suffix.
    if source.is_file() and not is_bag_file(source):
        lens = load_lens(camera) if known.car is None else load_calibration(CameraCalibration, camera)
        return _measure_photograph(source, record, sheet, lens, known)
    if known != KnownLength():
        raise CalibrationError(
            f"expected no --card, --distance, --width or --car with a bag, whose poses give the size, got {source}; leave them out"
        )
    return _measure_drive(source, record, sheet, load_calibration(CameraCalibration, camera))


def measured_files(path: Path) -> tuple[Path, Path]:
    """The JSON file of a measurement, and the picture of the print beside it."""
    return path, path.with_suffix(".png")


def write_measured(found: MeasuredPrint, effect: PlainData | None, path: Path) -> list[Path]:
    """Write a measurement as JSON, and beside it pictures of the print: nominal, as seen, and in even white light.

    Returns:
        The files.
    """
    data = found.measurement.to_dict() | ({} if effect is None else {"effect": effect.to_dict()})
    write_json(path, data)
    picture = measured_files(path)[1]
    if found.colours is None:
        picture.unlink(missing_ok=True)  # of an earlier measurement
        return [path]
    row = np.concatenate([found.colours.nominal, found.colours.seen, found.colours.unlit], axis=1)
    write_image(picture, row.repeat(4, axis=0).repeat(4, axis=1))
    return [path, picture]


def printed_sheet(record: PrintRecord, attack: AttackFile) -> Printable:
    """The poster of an attack, as its record says.

    Raises:
        PrintError: The record belongs to another poster.
    """
    record.require("poster")
    if record.attack_id != attack.attack_id:
        raise PrintError(
            f"expected attack {record.attack_id}, which was printed, got {attack.attack_id}; give its file with --attack"
        )
    names = [each.name for each in attack.objects]
    if record.object not in names:
        raise PrintError(unknown(record.object, "object", names))
    number = names.index(record.object)
    edge_m = None if attack.objects[number].size_m or attack.face else record.picture_m[0]
    return Printable(poster_of(attack, str(number), edge_m).texture, record.picture_m, record.frame)


def _measure_photograph(
    photo: Path, record: PrintRecord, sheet: Printable, lens: Intrinsics, known: KnownLength
) -> MeasuredPrint:
    rgb = read_picture(photo)
    _require_size(rgb, lens, photo.name)
    markers = find_markers(rgb, lens, record.markers)
    if not markers:
        raise DegenerateDataError(
            f"{photo}: expected the print in the photograph, found none of its {len(record.markers)} markers: {why_none(rgb)}"
        )
    card = known.card
    beside = None if card is None else (find_markers(rgb, lens, card.markers, "the card"), card.markers)
    pose = fit_print(markers, record.markers, lens.pinhole, beside)
    found = of_photograph(
        photo.name,
        record.picture_m,
        len(record.markers),
        pose,
        known.scale_of(pose, record.picture_m),
        _camera_in_world(lens, known),
    )
    outside = [
        number
        for number, corners in record.markers.items()
        if number not in markers and not in_picture(pose.laid.in_camera(corners), lens)
    ]
    found = replace(found, markers_outside=len(outside))
    by_car = isinstance(lens, CameraCalibration)
    return _with_colours(found, rgb, lens, pose.laid, record, sheet, pose.seen, by_car)


def _measure_drive(
    bag: Path, record: PrintRecord, sheet: Printable, camera: CameraCalibration
) -> MeasuredPrint:
    recorded, views, stamps, refused = read_poses(bag, CAR), list[PrintView](), list[int](), []
    poses = PoseBuffer.of_recording(zip(recorded.stamps_ns.tolist(), recorded.T, strict=True), _MOST_GAP_S)
    for stamp, rgb in read_frames(bag):
        _require_size(rgb, camera, bag.name)
        pose = poses.at(stamp)
        try:
            if pose is not None and (markers := find_markers(rgb, camera, record.markers)):
                views.append(PrintView(markers, pose.T @ camera.mount))
                stamps.append(stamp)
        except DegenerateDataError as error:  # of a drive, blurred and distant pictures are left out
            refused.append(error)
    _require_views(bag, len(views), refused)
    placed = place_print(thinned(views, _MOST_VIEWS), record.markers, camera.pinhole)
    poses_before = [invert_transform(each.T_world_from_camera) @ placed.T_world_from_face for each in views]
    for T in poses_before:
        T[:3, 3] /= placed.scale  # in nominal units
    best = _clearest(poses_before, views, camera, record.sheet_m)
    metres_per_px = placed.scale * float(np.linalg.norm(poses_before[best][:3, 3])) / camera.fx
    found = of_drive(bag.name, record.picture_m, len(record.markers), placed, metres_per_px)
    frame = next(rgb for stamp, rgb in read_frames(bag) if stamp == stamps[best])
    seen = tuple(views[best].markers)
    return _with_colours(found, frame, camera, LaidPrint(poses_before[best]), record, sheet, seen, True)


def _clearest(
    poses: Sequence[Array], views: Sequence[PrintView], lens: Intrinsics, sheet_m: tuple[float, float]
) -> int:
    """The view that shows the whole print with most markers, and largest."""
    corners = picture_points((2.0 * sheet_m[0], 2.0 * sheet_m[1]), 2, 2).reshape(-1, 3)

    def rank(k: int) -> tuple[bool, int, float]:
        before = transform_points(poses[k], corners)
        whole = bool((before[:, 2] > 0.0).all()) and in_picture(before, lens)
        return whole, len(views[k].markers), -float(np.linalg.norm(poses[k][:3, 3]))

    return max(range(len(views)), key=rank)


def _camera_in_world(lens: Intrinsics, known: KnownLength) -> Array | None:
    """``T_world_from_camera`` ``[4, 4]`` of the driving camera, from the pose of the car; None if it is unknown."""
    if known.car is None or not isinstance(lens, CameraCalibration):
        return None
    return planar_pose(*known.car) @ lens.mount


def _with_colours(
    found: PrintMeasurement,
    rgb: Rgb,
    lens: Intrinsics,
    laid: LaidPrint,
    record: PrintRecord,
    sheet: Printable,
    seen: tuple[int, ...],
    by_car: bool,
) -> MeasuredPrint:
    corners = {number: record.markers[number] for number in seen}
    try:
        colours = print_colours(rgb, lens, laid, sheet, corners)
    except DegenerateDataError as error:
        return MeasuredPrint(replace(found, colours_unknown=str(error)), None, by_car)
    return MeasuredPrint(replace(found, colours=colours.error), colours, by_car)


def _require_views(bag: Path, views: int, refused: Sequence[DegenerateDataError]) -> None:
    """Refuse a drive whose pictures show no print, or two of one kind; ``refused`` are the errors of those that were left out."""
    twice = [error for error in refused if isinstance(error, SeenTwiceError)]
    if len(twice) > _MOST_TWICE * (views + len(twice)):
        raise DegenerateDataError(f"{bag}: {twice[0]}")
    if not views:
        why = f" ({len(refused)} were left out, the first for this: {refused[0]})" if refused else ""
        raise DegenerateDataError(
            f"{bag}: expected pictures of the print from known poses of {CAR}, got none{why}; drive nearer, or print larger markers"
        )


def _require_size(rgb: Rgb, lens: Intrinsics, name: str) -> None:
    height, width = rgb.shape[:2]
    if (width, height) != (lens.width, lens.height):
        raise CalibrationError(
            f"{name}: expected {lens.width} x {lens.height} pixels, as its lens was calibrated, got {width} x {height}; give the lens of this camera, and "
            "photographs that were not cropped, scaled or turned"
        )
