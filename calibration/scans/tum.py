"""Reads recordings in the layout of the TUM RGB-D benchmark, which ETH3D SLAM and others share.

Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. A row of the trajectory is ``timestamp [s] tx ty tz [m] qx qy qz qw``, the pose of the colour camera, with
OpenCV's axes. ``groundtruth.txt`` is from motion capture: metric, z up. Others are from SLAM, whose unit and directions are its own. ``rgb.txt`` and ``depth.txt`` list ``timestamp file``. Pixel centres are whole numbers.
"""

from __future__ import annotations

import io
import re
from functools import partial
from pathlib import Path

import numpy as np

from advnerf_core.data.image_files import image_size
from advnerf_core.data.lens import Lens
from advnerf_core.data.scan_folder import trajectories
from advnerf_core.documents import read_text
from advnerf_core.geometry import Array, Pinhole
from calibration.scans.depth import DepthView, depth_points, disagreement
from calibration.scans.scan import Scan, ScanError, ScanOptions, images_in, lens_of, model_of, pinhole_of
from calibration.scans.timed_images import Placed, TimedImage, place_images
from calibration.scans.trajectory import Trajectory, require_order, stamp_ns, trajectory_of
from calibration.schema import CameraCalibration, load_calibration

OPTIONS = ("images", "calibration")
_METRIC = "groundtruth.txt"
_UNKNOWN = (
    "unknown: lengths are in the unit of {file}, which monocular SLAM does not know; give --length, --positions or --marker, "
    f"or rename the file to {_METRIC} if it is in metres with z up"
)
_LISTS, _FOLDERS = ("rgb.txt", "images.txt"), ("rgb", "images", "image_0", ".")
_DEPTH_LIST, _CALIBRATION = "depth.txt", "calibration.txt"
# The benchmark's scale, and millimetres, as RealSense and ROS write them.
_VALUES_PER_M, _FARTHEST_M = (5000.0, 1000.0), 5.0
# The millimetre is taken if views agree so much better by it; above the share, they agree by no scale.
_CLEARLY, _MOST_DISAGREEMENT = 0.5, 0.2
_DEPTH_WITHIN_NS = 20_000_000
# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: fx, fy, cx, cy and k1, k2, p1, p2, k3 of the colour cameras.
_FREIBURG = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


def read(path: Path, options: ScanOptions) -> Scan:
    """Read a recording with one trajectory.

    Raises:
        ScanError: Poses, images or the lens are missing or wrong.
    """
    trajectory = _trajectory(path)
    placed = place_images(
        _timed(path, options), trajectory, "camera", partial(_intrinsics, path, options), options, np.eye(4)
    )
    facts = {"rows_without_pose": trajectory.dropped}
    if trajectory.file.name != _METRIC:
        model = model_of(placed.images, placed.left_out, path)
        return Scan(model, placed.pictures, _UNKNOWN.format(file=trajectory.file.name), facts=facts)
    points, said = _depth(path, placed)
    model = model_of(placed.images, placed.left_out, path, points)
    unit = f"metric: lengths of the trajectory{said}"
    return Scan(model, placed.pictures, unit, True, np.eye(3), facts=facts)


def _trajectory(path: Path) -> Trajectory:
    files = trajectories(path)
    if len(files) != 1 and files[0].name != _METRIC:
        names = ", ".join(each.name for each in files)
        raise ScanError(f"{path}: expected one trajectory, got {names}; remove the others")
    rows = _numbers(files[0])
    if rows.shape[1] != 8:
        raise ScanError(
            f"{files[0]}: expected rows timestamp tx ty tz qx qy qz qw, got {rows.shape[1]} columns; export the trajectory again"
        )
    for line in read_text(files[0]).splitlines():
        if line.startswith("#") and len(columns := line.strip("# ").replace(",", " ").split()) == 8:
            require_order(columns[1:], "xyzxyzw", files[0])
    stamps = [stamp_ns(float(each), str(files[0])) for each in rows[:, 0]]
    return trajectory_of(stamps, rows[:, 1:], files[0])


def _numbers(file: Path) -> Array:
    """Rows of numbers ``[N, M]`` of a text file."""
    text = read_text(file)
    try:
        return np.loadtxt(io.StringIO(text), dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise ScanError(
            f"{file}: expected rows of numbers, got: {str(error).splitlines()[0]}; export the file again"
        ) from None


def _timed(path: Path, options: ScanOptions) -> list[TimedImage]:
    listed = next((path / name for name in _LISTS if (path / name).is_file()), None)
    if options.images is None and listed is not None:
        return [TimedImage(file.name, file, stamp) for stamp, file in _listed(listed)]
    folders = [options.images] if options.images is not None else [path / name for name in _FOLDERS]
    files = next((found for folder in folders if (found := images_in(folder))), [])
    if not files:
        raise ScanError(
            f"{path}: expected images listed in rgb.txt, or in the folder rgb, found none; put them there, or give their folder with --images"
        )
    return [TimedImage(file.name, file, _stamp_of_name(file)) for file in files]


def _stamp_of_name(file: Path) -> int:
    # 000123 is a frame's number: seconds have a fraction, or ten digits since 1970.
    if not re.fullmatch(r"\d{1,19}\.\d+|[1-9]\d{9,18}", file.stem):
        raise ScanError(
            f"{file}: expected the time stamp [s] as the name of an image, such as 1305031102.1753.png, got {file.stem}; "
            "list the images in rgb.txt: timestamp file"
        )
    return stamp_ns(float(file.stem), str(file))


def _listed(file: Path) -> list[tuple[int, Path]]:
    rows = []
    for line, text in enumerate(read_text(file).splitlines(), 1):
        words, where = text.split(maxsplit=1), f"{file}:{line}"
        if not words or words[0].startswith("#"):
            continue
        name = Path(words[-1].strip().replace("\\", "/"))
        if len(words) != 2 or name.is_absolute() or ".." in name.parts:
            raise ScanError(
                f"{where}: expected a time stamp and a file in {file.parent}, got {text.strip()!r:.60}; correct the line"
            )
        try:
            rows.append((stamp_ns(float(words[0]), where), file.parent / name))
        except (ValueError, OverflowError):
            raise ScanError(
                f"{where}: expected a time stamp [s], got {words[0]!r:.60}; correct the line"
            ) from None
    return rows


def _intrinsics(path: Path, options: ScanOptions, image: Path) -> tuple[Pinhole, Lens]:
    if options.calibration is not None:
        known = load_calibration(CameraCalibration, options.calibration)
        return known.pinhole, Lens(known.distortion)
    width, height = image_size(image)
    file, kinect = path / _CALIBRATION, re.search(r"freiburg([123])", path.resolve().name)
    if file.is_file():
        values = _numbers(file)
        if values.shape != (1, 4):
            raise ScanError(
                f"{file}: expected fx fy cx cy, got {list(values.shape)} numbers; give the lens with --calibration camera.yaml"
            )
        (fx, fy, cx, cy), lens, where = values[0].tolist(), Lens(), str(file)
    elif kinect is not None and (width, height) == (640, 480):
        (fx, fy, cx, cy), coefficients = _FREIBURG[kinect[1]]
        lens, where = Lens(coefficients), kinect[0]
    else:
        raise ScanError(
            f"{path}: expected the camera's lens in {_CALIBRATION} (fx fy cx cy), found none; put it there, or give --calibration camera.yaml"
        )
    pinhole = pinhole_of(width, height, (fx, fy, cx + 0.5, cy + 0.5), where)
    return pinhole, lens_of(pinhole, lens, where)


def _depth(path: Path, placed: Placed) -> tuple[Array, str]:
    """Points ``[M, 3]`` of the depth images, which are aligned with the colour images, and their scale in words."""
    if not (path / _DEPTH_LIST).is_file():
        return np.zeros((0, 3)), ""
    depth = sorted(_listed(path / _DEPTH_LIST))
    stamps = np.array([stamp for stamp, _ in depth], np.int64)
    views = []
    for image, stamp in zip(placed.images, placed.stamps_ns, strict=True):
        if len(stamps) and np.abs(stamps - stamp).min() <= _DEPTH_WITHIN_NS:
            file = depth[int(np.abs(stamps - stamp).argmin())][1]
            views.append(DepthView(file, image.pinhole, image.T_world_from_camera))
    scale = _scale(views, path)
    points = depth_points(views, scale, _FARTHEST_M)
    return points, f"; depth images have {scale:g} values per metre" if len(points) else ""


def _scale(views: list[DepthView], path: Path) -> float:
    """Values of a pixel at one metre, which no file says: by them, views from different places agree."""
    usual, other = ((disagreement(views, each, _FARTHEST_M), each) for each in _VALUES_PER_M)
    differ, scale = other if other[0] < _CLEARLY * usual[0] else usual
    if differ > _MOST_DISAGREEMENT:
        raise ScanError(
            f"{path / _DEPTH_LIST}: expected depth images of {_VALUES_PER_M[0]:g} values per metre, or in millimetres, got ones that differ by "
            f"{100 * differ:.0f} % between views by either; convert them, or remove the file: points of the scene help only to find the ground"
        )
    return scale
