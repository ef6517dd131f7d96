"""Reads poses, frames and commands from a bag, and finds the times at which car and board stood still."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.csv_rows import read_csv
from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import read_stored
from advnerf_core.data.similarity import rotation_angles
from advnerf_core.errors import ConfigError, MissingFileError
from advnerf_core.files import natural_order
from advnerf_core.geometry import Array
from calibration.camera_to_car import MountView
from calibration.charuco import BoardDetector, Detection
from calibration.degeneracy import DegenerateDataError, mean_transform
from calibration.display_colour import mean_colour, screen_region
from calibration.schema import CalibrationError, CameraCalibration, parse_calibration
from calibration.vehicle import RecordedDrive
from nodes.bags import decoded
from nodes.bags.images import image_messages, image_topic
from nodes.bags.parts import holds_bag
from nodes.bags.reader import read_attachments, read_info
from nodes.runtime.errors import BagError
from nodes.runtime.messages import stamp_ns
from nodes.runtime.pictures import rgb_image

Rgb = NDArray[np.uint8]
IMAGES, CAR, SENT = "/camera/image_raw", "/vicon/car", "/motor/sent"
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# Poses within this time before and after a frame are checked and averaged [s].
_HALF_WINDOW_S = 0.15
# Motion capture, and tracks that are driven by hand, are smaller [m].
_WIDEST_M = 1000.0
# A car that is not on a slope nor lifted moves less up and down, than this share of its way and than this [m].
_STEEPEST, _LIFTED_M = 0.5, 0.5
# Largest distance of a pose from their mean [m].
_MOST_MOTION_M = 0.004
# Markers' noise and floors are less off.
_MOST_HEIGHT_MM, _MOST_TILT_DEG = 20.0, 1.5
# Largest angle of a pose from their mean [rad].
_MOST_TURN_RAD = 0.008
# Poses of one stop differ less, those of two more.
_ELSEWHERE_M, _ELSEWHERE_RAD = 0.02, 0.02


@dataclass(frozen=True, eq=False)
class PoseSeries:
    """Poses of a subject.

    Attributes:
        stamps_ns: Increasing ``[N]`` [ns since 1970].
        T: ``[N, 4, 4]``.
    """

    stamps_ns: NDArray[np.int64]
    T: Array

    def around(self, stamp: int, half_ns: int) -> Array | None:
        """Poses ``[n, 4, 4]`` within ``half_ns`` of a stamp; None unless there are poses on both sides."""
        first, last = np.searchsorted(self.stamps_ns, [stamp - half_ns, stamp + half_ns])
        middle = int(np.searchsorted(self.stamps_ns, stamp))
        return self.T[first:last] if first < middle < last and last - first >= 3 else None


def camera_of(bag: Path) -> CameraCalibration | None:
    """The camera file that was attached to a bag when it was recorded; None without one.

    Raises:
        CalibrationError: It is none.
    """
    content = read_attachments(bag).get("camera.yaml")
    return None if content is None else parse_calibration(CameraCalibration, content, f"camera.yaml of {bag}")


def read_poses(bag: Path, topic: str) -> PoseSeries:
    """Read all finite poses of a topic, in order of their stamps."""
    _require(bag, topic)
    rows = dict(decoded.read_poses(bag, topic))
    if len(rows) < 2:
        raise DegenerateDataError(
            f"expected poses on {topic} in {bag}, got {len(rows)}; was motion capture on?"
        )
    stamps = sorted(rows)
    found = PoseSeries(np.array(stamps, np.int64), np.stack([rows[stamp] for stamp in stamps]))
    require_metres_and_z_up(found.T, bag, topic)
    return found


def require_metres_and_z_up(T: Array, bag: Path, topic: str) -> None:
    """Refuse poses ``[N, 4, 4]`` of motion capture in another unit or with another axis up.

    Raises:
        DegenerateDataError: They are.
    """
    span_m = float(np.linalg.norm(np.ptp(T[:, :3, 3], axis=0)))
    if span_m > _WIDEST_M:
        raise DegenerateDataError(
            f"expected positions on {topic} in {bag} within {_WIDEST_M:g} m, got {span_m:.4g} m: are they in mm? Let motion capture send metres"
        )
    low, high = np.percentile(T[:, :3, 3], (5, 95), axis=0)
    x_m, y_m, z_m = high - low
    if topic == CAR and z_m > max(_STEEPEST * max(x_m, y_m), _LIFTED_M):
        raise DegenerateDataError(
            f"expected a car that drives on a floor on {topic} in {bag}, got {z_m:.2f} m up and down, {x_m:.2f} m along x and {y_m:.2f} m along y: is y up "
            "in motion capture? Set z up"
        )


def origin_remark(bag: Path) -> str:
    """A warning if the car's subject has its origin above or below the floor, or axes that are not level; empty if it has not."""
    T = read_poses(bag, CAR).T
    height_mm = 1000.0 * float(np.median(T[:, 2, 3]))
    tilt_deg = float(np.degrees(np.median(np.arccos(np.clip(T[:, 2, 2], -1.0, 1.0)))))
    if abs(height_mm) <= _MOST_HEIGHT_MM and tilt_deg <= _MOST_TILT_DEG:
        return ""
    return (
        f"warning: expected a subject whose origin is on the floor and whose z axis points up, got the origin {height_mm:+.0f} mm from the floor and the "
        f"axis {tilt_deg:.1f} degrees off. Move it in Tracker before you calibrate: simulated cars stand on their origin, and the camera's height and "
        "pitch would be wrong there by as much"
    )


def read_frames(bag: Path) -> Iterator[tuple[int, Rgb]]:
    """Yield stamp [ns] and RGB image ``[H, W, 3]`` of every frame."""
    topic = image_topic(bag)
    for message in image_messages(bag, topic):
        yield stamp_ns(message), rgb_image(message, f"{topic} in {bag}")


def read_pictures(source: Path) -> Iterator[tuple[str, Rgb]]:
    """Yield name and image of every file of a folder, or of every frame of a bag."""
    if source.is_dir() and not holds_bag(source):
        found = (file for file in source.glob("[!.]*") if file.suffix.lower() in PICTURES)
        files = sorted(found, key=lambda file: natural_order(file.name))
        if not files:
            raise CalibrationError(
                f"expected a bag, or a folder of pictures ({', '.join(PICTURES)}), got {source}"
            )
        for file in files:
            yield file.name, read_picture(file)
        return
    for stamp, image in read_frames(source):
        yield str(stamp), image


def read_picture(file: Path) -> Rgb:
    """Read an image file as RGB ``[H, W, 3]``, as stored: a lens is calibrated on the pixels that the camera gives."""
    try:
        return read_stored(file)[0]
    except DatasetError as error:
        raise CalibrationError(str(error)) from error


def read_drive(bag: Path) -> RecordedDrive:
    """Read the commands sent to the motor controller, and the poses of the car."""
    _require(bag, SENT)
    rows = []
    for message in decoded.read_decoded(bag, SENT):
        written = int(message.serial_write_real_ns)
        erpm = np.nan if message.braking else float(message.erpm)
        pipeline = np.nan if message.braking else (written - stamp_ns(message)) / 1e9
        rows.append((written, float(message.servo), erpm, pipeline))
    if len(rows) < 2:
        raise DegenerateDataError(
            f"expected commands on {SENT} in {bag}, got {len(rows)}; was the car armed?"
        )
    rows.sort(key=lambda row: row[0])
    poses = read_poses(bag, CAR)
    start = int(poses.stamps_ns[0])
    yaw = np.unwrap(np.arctan2(poses.T[:, 1, 0], poses.T[:, 0, 0]))
    planar = np.stack([poses.T[:, 0, 3], poses.T[:, 1, 3], yaw], axis=1)
    when = np.array([(row[0] - start) / 1e9 for row in rows])
    # Telemetry and commands may have the same microsecond, but times must increase.
    kept = np.concatenate([[True], np.diff(when) > 0.0])
    table = np.array([row[1:] for row in rows])[kept]
    return RecordedDrive(
        (poses.stamps_ns - start) / 1e9, planar, when[kept], table[:, 0], table[:, 1], table[:, 2]
    )


def still_views(
    bag: Path, detector: BoardDetector, board_topic: str | None, size: tuple[int, int]
) -> tuple[list[MountView], int]:
    """Find the middle frame with a board in view of each time that car and board stood still.

    Args:
        board_topic: Topic of the board's poses; None if it is not tracked.
        size: Width and height of the frames that the lens was calibrated for [px].

    Returns:
        The views, and the number of frames in the bag.

    Raises:
        DegenerateDataError: The frames have another size.
    """
    car = read_poses(bag, CAR)
    board = None if board_topic is None else read_poses(bag, board_topic)
    stops: list[list[MountView]] = [[]]
    count = 0
    for stamp, image in read_frames(bag):
        count += 1
        if image.shape[1::-1] != size:
            raise DegenerateDataError(
                f"expected frames of {size[0]} x {size[1]}, as the lens was calibrated for, got {image.shape[1]} x {image.shape[0]} in {bag}; give the "
                "lens of this camera and resolution with --lens"
            )
        view = _still_view(stamp, image, car, board, detector)
        if view is not None:
            if stops[-1] and _is_elsewhere(view, stops[-1][0]):  # no frame was taken on the way
                stops.append([])
            stops[-1].append(view)
        elif stops[-1]:
            stops.append([])
    return [stop[round(0.5 * (len(stop) - 1))] for stop in stops if stop], count


def _is_elsewhere(view: MountView, other: MountView) -> bool:
    """Whether car or board have moved between two views."""
    pairs = [(view.T_world_from_car, other.T_world_from_car)]
    if view.T_world_from_board is not None and other.T_world_from_board is not None:
        pairs.append((view.T_world_from_board, other.T_world_from_board))
    return any(
        float(np.linalg.norm(one[:3, 3] - two[:3, 3])) > _ELSEWHERE_M
        or float(rotation_angles(two[:3, :3].T @ one[:3, :3])) > _ELSEWHERE_RAD
        for one, two in pairs
    )


def read_shown(folder: Path) -> tuple[Array, Array, Array]:
    """Read shown colours and their camera means ``[N, 3]`` in 0..1, and cosines of the viewing angle ``[N]``, from a folder with ``shown.csv``.

    Its columns are ``file, red, green, blue`` (0..255) and optionally ``cos_angle``. Consecutive rows of one colour are averaged. The
    screen is found by the difference between the first black and the first white image of each angle.
    """
    table = folder / "shown.csv"
    try:
        keyed = [
            (
                (row.number("red"), row.number("green"), row.number("blue"), row.number("cos_angle", 1.0)),
                folder / row.values["file"],
            )
            for row in read_csv(table, ("file", "red", "green", "blue"))
        ]
    except MissingFileError:
        raise CalibrationError(
            f"expected {table} with columns file, red, green, blue, found none; write one row per image"
        ) from None
    except ConfigError as error:
        raise CalibrationError(str(error)) from error
    regions = {angle: _region(keyed, angle) for angle in {key[3] for key, _ in keyed}}
    shown, seen, angles = [], [], []
    for key, group in groupby(keyed, key=lambda row: row[0]):
        shown.append(np.array(key[:3]) / 255.0)
        pictures = [read_picture(file) for _, file in group]
        region = regions[key[3]]
        if any(picture.shape[:2] != region.shape for picture in pictures):
            raise CalibrationError(
                f"expected pictures of {region.shape[1]} x {region.shape[0]} in {folder}, as the black one, got others too"
            )
        seen.append(mean_colour(pictures, region))
        angles.append(key[3])
    return np.array(shown).reshape(-1, 3), np.array(seen).reshape(-1, 3), np.array(angles)


def has_topic(bag: Path, topic: str) -> bool:
    """Whether a bag has messages of a topic."""
    return any(row.name == topic and row.count > 0 for row in read_info(bag).topics)


def _require(bag: Path, topic: str) -> None:
    if not has_topic(bag, topic):
        found = ", ".join(row.name for row in read_info(bag).topics if row.count)
        raise BagError(f"expected {topic} in {bag}, got {found or 'no messages'}; record this topic too")


def _still_view(
    stamp: int,
    image: Rgb,
    car: PoseSeries,
    board: PoseSeries | None,
    detector: BoardDetector,
) -> MountView | None:
    T_car = _still_pose(car, stamp)
    T_board = None if board is None else _still_pose(board, stamp)
    if T_car is None or (board is not None and T_board is None):
        return None
    found: Detection | None = detector.find(image)
    return None if found is None else MountView(T_car, T_board, found)


def _still_pose(series: PoseSeries, stamp: int) -> Array | None:
    poses = series.around(stamp, round(_HALF_WINDOW_S * 1e9))
    if poses is None:
        return None
    mean = mean_transform(poses)
    moved = float(np.linalg.norm(poses[:, :3, 3] - mean[:3, 3], axis=1).max())
    turned = float(rotation_angles(mean[:3, :3].T @ poses[:, :3, :3]).max())
    return mean if moved <= _MOST_MOTION_M and turned <= _MOST_TURN_RAD else None


def _region(keyed: Sequence[tuple[tuple[float, ...], Path]], angle: float) -> NDArray[np.bool_]:
    ends: list[Rgb] = []
    for level, name in ((0.0, "black"), (255.0, "white")):
        file = next((file for key, file in keyed if key[:3] == (level,) * 3 and key[3] == angle), None)
        if file is None:
            raise DegenerateDataError(
                f"expected a {name} picture at every angle, got none: the screen is found by it"
            )
        ends.append(read_picture(file))
    if ends[0].shape != ends[1].shape:
        raise CalibrationError("expected the black and the white picture to have one size")
    return screen_region(ends[0], ends[1])
