"""Reads Record3D's recordings: ``.r3d`` archives, unpacked ones, and the export of images with ``metadata.json``.

Format: https://github.com/marek-simonik/record3d, issues 27 and 33. ``poses`` are ``qx qy qz qw x y z`` of an OpenGL camera (x right, y up, z backward),
in metres, relative to the first image: the direction of gravity is not recorded. ``K`` is stored by columns.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from advnerf_core.data.image_files import read_bytes
from advnerf_core.data.lens import Lens
from advnerf_core.data.scan_folder import record3d_source
from advnerf_core.documents import parse_json
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Array, make_transform, rotation_from_quaternion
from calibration.photo_model import LeftOut, Registered
from calibration.scans.scan import (
    MOST_OF_RECORDING,
    Picture,
    Scan,
    ScanError,
    ScanOptions,
    model_of,
    number,
    pinhole_of,
    spread,
)

OPTIONS: tuple[str, ...] = ()
_METADATA, _FOLDERS = ("metadata", "metadata.json"), ("rgbd", "rgb")
_LARGEST_BYTES = 2**26
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError)


def read(path: Path, options: ScanOptions) -> Scan:
    """Read a recording.

    Raises:
        ScanError: The scan is damaged, or has too few images.
    """
    source = record3d_source(path)
    if source is None:
        raise ScanError(f"{path}: expected a Record3D recording (.r3d), found none; correct the path")
    names = _names(source)
    metadata = next((each for each in _METADATA if each in names), None)
    if metadata is None:
        raise ScanError(
            f"{source}: expected the file metadata in it, found none; export the recording again as .r3d"
        )
    where = f"{source}: {metadata}"
    values = parse_json(_content(source, metadata), where)
    poses = values.get("poses") if isinstance(values, dict) else None
    if not isinstance(poses, list) or not poses or not all(key in values for key in ("w", "h")):
        raise ScanError(f"{where}: expected the keys poses, w, h and K; export the recording again as .r3d")
    found, left_out, pictures = list[Registered](), list[LeftOut](), dict[str, Picture]()
    digits = len(str(len(poses) - 1))
    for index in spread(len(poses), options.most or MOST_OF_RECORDING):
        try:
            name = _image_of(names, index)
            one = _image(values, index, name, where)
        except ScanError as error:
            left_out.append(LeftOut(f"rgbd/{index}.jpg", str(error)))
            continue
        found.append(one)
        ordered = f"{index:0{digits}d}{Path(name).suffix}"
        pictures[name] = Picture(
            ordered, partial(_content, source, name), one.pinhole.width, one.pinhole.height
        )
    return Scan(model_of(found, left_out, source), pictures, "metric: lengths of ARKit", True)


def _image(values: dict[str, Any], index: int, name: str, where: str) -> Registered:
    where = f"{where}: poses: {index}"
    pinhole = pinhole_of(values["w"], values["h"], _intrinsics(values, index, where), where)
    return Registered(
        name, "phone", _pose(values["poses"][index], where) @ OPENGL_FROM_OPENCV, pinhole, Lens()
    )


def _pose(values: Any, where: str) -> Array:
    if not isinstance(values, list) or len(values) != 7:
        raise ScanError(f"{where}: expected 7 numbers qx qy qz qw x y z, got {values!r:.60}")
    numbers = [number(each, where) for each in values]
    try:
        return make_transform(rotation_from_quaternion(numbers[:4]), numbers[4:])
    except ValueError as error:
        raise ScanError(f"{where}: {error}") from None


def _intrinsics(values: dict[str, Any], index: int, where: str) -> Sequence[Any]:
    """``fx, fy, cx, cy`` of an image."""
    each, K = values.get("perFrameIntrinsicCoeffs"), values.get("K")
    if isinstance(each, list) and len(each) == len(values["poses"]):
        if not isinstance(each[index], list) or len(each[index]) != 4:
            raise ScanError(
                f"{where}: perFrameIntrinsicCoeffs: expected fx fy cx cy, got {each[index]!r:.60}"
            )
        return each[index]
    if not isinstance(K, list) or len(K) != 9:
        raise ScanError(f"{where}: K: expected 9 numbers, got {K!r:.60}; export the recording again")
    return K[0], K[4], K[6], K[7]


def _image_of(names: frozenset[str], index: int) -> str:
    there = (
        name
        for folder in _FOLDERS
        for suffix in ("jpg", "png")
        if (name := f"{folder}/{index}.{suffix}") in names
    )
    found = next(there, None)
    if found is None:
        raise ScanError(f"rgbd/{index}.jpg is not in the recording")
    return found


def _names(source: Path) -> frozenset[str]:
    if source.is_dir():
        return frozenset(each.relative_to(source).as_posix() for each in source.rglob("*") if each.is_file())
    try:
        with zipfile.ZipFile(source) as archive:
            return frozenset(archive.namelist())
    except _DAMAGED as error:
        raise _unreadable(source, error) from None


def _content(source: Path, name: str) -> bytes:
    if source.is_dir():
        return read_bytes(source / name)
    try:
        with zipfile.ZipFile(source) as archive, archive.open(name) as stream:
            data = stream.read(_LARGEST_BYTES + 1)
    except (*_DAMAGED, KeyError) as error:
        raise _unreadable(source, error) from None
    if len(data) > _LARGEST_BYTES:
        raise ScanError(
            f"{source}: expected files below {_LARGEST_BYTES >> 20} MiB, got a larger {name}; export the recording again"
        )
    return data


def _unreadable(source: Path, error: BaseException) -> ScanError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return ScanError(
        f"{source}: expected a whole archive of Record3D, got: {reason}; copy it from the phone again"
    )
