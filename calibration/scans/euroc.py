"""Reads recordings in the layout of the EuRoC MAV data set (ASL), which TUM-VI and others share.

Format: https://projects.asl.ethz.ch/datasets, "ASL Dataset Format". ``sensor.yaml`` has ``T_BS``, the pose of a sensor in the body; ``data.csv`` of the ground truth
has the pose of that sensor in the world: ``timestamp [ns], p x y z [m], q w x y z``. Cameras are as in OpenCV, whose pixel centres are whole numbers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.csv_rows import read_csv
from advnerf_core.data.lens import Lens
from advnerf_core.data.scan_folder import euroc_root
from advnerf_core.documents import parse_yaml, read_text
from advnerf_core.geometry import Array, Pinhole, invert_transform
from calibration.photo_model import LeftOut, Registered
from calibration.scans.scan import (
    MOST_OF_RECORDING,
    Picture,
    Scan,
    ScanError,
    ScanOptions,
    lens_of,
    model_of,
    number,
    pinhole_of,
    pose_of,
)
from calibration.scans.timed_images import TimedImage, place_images
from calibration.scans.trajectory import Trajectory, require_order, trajectory_of
from calibration.schema import CameraCalibration, load_calibration

OPTIONS = ("images", "calibration")
# The first has been smoothed and belongs to the IMU.
_POSES = ("state_groundtruth_estimate0", "mocap0", "vicon0", "gt0")
_POSE_COLUMNS = 8
_BROWN, _FISHEYE, _NONE = ("radial-tangential", "radtan"), ("equidistant",), ("none", "")


def read(path: Path, options: ScanOptions) -> Scan:
    """Read all cameras of a recording.

    Raises:
        ScanError: Poses, images or a lens are missing or wrong.
    """
    root = euroc_root(path) or path
    trajectory = _trajectory(root)
    found, left_out, pictures = list[Registered](), list[LeftOut](), dict[str, Picture]()
    cameras = sorted(each.parent for each in root.glob("cam*/data.csv"))
    _require_one_camera(root, cameras, options)
    share = max((options.most or MOST_OF_RECORDING) // len(cameras), 1)
    for camera in cameras:
        sensor = _sensor(camera)
        intrinsics = _intrinsics(camera, sensor, options)
        placed = place_images(
            _timed(camera, options),
            trajectory,
            camera.name,
            lambda _, known=intrinsics: known,  # type: ignore[misc]
            ScanOptions(most=share),
            _in_body(camera, sensor),
        )
        found += placed.images
        left_out += placed.left_out
        pictures |= placed.pictures
    facts = {"rows_without_pose": trajectory.dropped}
    unit = "metric: lengths of the recording's ground truth"
    return Scan(model_of(found, left_out, path), pictures, unit, True, np.eye(3), facts=facts)


def _require_one_camera(root: Path, cameras: Sequence[Path], options: ScanOptions) -> None:
    """Refuse options that would give several cameras one folder of images, whose names they share, or one lens."""
    given = [f"--{name}" for name in OPTIONS if getattr(options, name) is not None]
    if given and len(cameras) > 1:
        raise ScanError(
            f"{root}: expected {' and '.join(given)} for a recording of one camera, got {', '.join(each.name for each in cameras)}; "
            "leave the option out, or give a copy of the recording without the other cameras"
        )


def _trajectory(root: Path) -> Trajectory:
    files = [root / name / "data.csv" for name in _POSES if (root / name / "data.csv").is_file()]
    if not files:
        there = ", ".join(sorted(each.name for each in root.iterdir()))
        raise ScanError(
            f"{root}: expected poses in {' or '.join(_POSES)}, got {there}; positions alone do not place a camera; "
            "export the ground truth there, or give photographs to advnerf scene from-images"
        )
    file = files[0]
    rows = read_csv(file)
    require_order(list(rows[0].values)[1:_POSE_COLUMNS] if rows else (), "xyzwxyz", file)
    stamps, values = list[int](), list[list[float]]()
    for row in rows:
        texts = list(row.values.values())
        if len(texts) < _POSE_COLUMNS:
            raise ScanError(
                f"{row.place}: expected timestamp, x, y, z, qw, qx, qy, qz, got {len(texts)} columns; export the file again"
            )
        x, y, z, qw, qx, qy, qz = (_number(text, row.place) for text in texts[1:_POSE_COLUMNS])
        stamps.append(_stamp(texts[0], row.place))
        values.append([x, y, z, qx, qy, qz, qw])
    trajectory = trajectory_of(stamps, np.array(values).reshape(-1, 7), file)
    T_sensor_from_body = invert_transform(_in_body(file.parent, _sensor(file.parent)))
    return Trajectory(trajectory.stamps_ns, trajectory.poses @ T_sensor_from_body, trajectory.dropped, file)


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ScanError(f"{where}: expected a number, got {text!r:.60}; correct the row") from None


def _stamp(text: str, where: str) -> int:
    try:
        stamp = int(text)
    except ValueError:
        raise ScanError(
            f"{where}: expected a time stamp in whole nanoseconds, got {text!r:.60}; correct the row"
        ) from None
    if not 0 <= stamp < 2**63:
        raise ScanError(f"{where}: expected a time stamp in nanoseconds, got {stamp:.3g}; correct the row")
    return stamp


def _timed(camera: Path, options: ScanOptions) -> Sequence[TimedImage]:
    rows = read_csv(camera / "data.csv")
    timed = []
    for row in rows:
        texts = [text.strip() for text in row.values.values()]
        if len(texts) < 2 or Path(texts[1]).name != texts[1] or texts[1] in ("", ".", ".."):
            raise ScanError(
                f"{row.place}: expected a time stamp and the name of a file, got {', '.join(texts)!r:.60}; correct the row"
            )
        folder = camera / "data" if options.images is None else options.images
        timed.append(TimedImage(f"{camera.name}/{texts[1]}", folder / texts[1], _stamp(texts[0], row.place)))
    return timed


def _sensor(folder: Path) -> dict[str, Any]:
    """Content of a sensor's ``sensor.yaml``; empty without one."""
    file = folder / "sensor.yaml"
    content = parse_yaml(_without_opencv(read_text(file)), str(file)).data if file.is_file() else {}
    if not isinstance(content, dict):
        raise ScanError(
            f"{file}: expected keys and values, got {type(content).__name__}; copy the file again"
        )
    return content


def _without_opencv(text: str) -> str:
    """Plain YAML of a file of OpenCV's ``FileStorage``: its first line and the tag of its matrices are its own; lines keep their numbers."""
    return re.sub(r"\A%YAML:1\.0|!!opencv-matrix\b", "", text)


def _in_body(folder: Path, sensor: dict[str, Any]) -> Array:
    """``T_body_from_sensor [4, 4]``; the identity without one."""
    T = sensor.get("T_BS")
    if T is None:
        return np.eye(4)
    where = f"{folder / 'sensor.yaml'}: T_BS"
    data = T.get("data") if isinstance(T, dict) else None
    if not isinstance(data, list) or len(data) != 16:
        raise ScanError(f"{where}: expected 16 numbers in data, got {data!r:.60}; copy the file again")
    return pose_of(np.reshape([number(each, where) for each in data], (4, 4)), where)


def _intrinsics(camera: Path, sensor: dict[str, Any], options: ScanOptions) -> tuple[Pinhole, Lens]:
    if options.calibration is not None:
        known = load_calibration(CameraCalibration, options.calibration)
        return known.pinhole, Lens(known.distortion)
    where = str(camera / "sensor.yaml")
    size, values = sensor.get("resolution"), sensor.get("intrinsics")
    if not (isinstance(size, list) and len(size) == 2 and isinstance(values, list) and len(values) == 4):
        raise ScanError(
            f"{where}: expected resolution and intrinsics of the camera, found none; give its lens with --calibration camera.yaml"
        )
    fx, fy, cx, cy = (number(each, where) for each in values)
    pinhole = pinhole_of(size[0], size[1], (fx, fy, cx + 0.5, cy + 0.5), where)
    return pinhole, lens_of(pinhole, _lens(sensor, where), where)


def _lens(sensor: dict[str, Any], where: str) -> Lens:
    model = (str(sensor.get("camera_model", "pinhole")), str(sensor.get("distortion_model") or ""))
    raw = sensor.get("distortion_coefficients") or []
    k = [number(each, where) for each in raw] if isinstance(raw, list) else []
    if model[0] == "pinhole" and model[1] in _BROWN and len(k) in (4, 5):
        return Lens((*k, *[0.0] * (5 - len(k))))
    if model[0] == "pinhole" and model[1] in _FISHEYE and len(k) == 4:
        return Lens(tuple(k), fisheye=True)
    if model[0] == "pinhole" and model[1] in _NONE and not any(k):
        return Lens()
    raise ScanError(
        f"{where}: expected a pinhole with radial-tangential (4 or 5 coefficients), equidistant (4) or no distortion, got {model[0]}, "
        f"{model[1] or 'no distortion model'}, {len(k)} coefficients; undistort the images first, and give their lens with --calibration camera.yaml"
    )
