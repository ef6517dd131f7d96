"""Finds COLMAP models in folders, and checks the structure of their binary files.

pycolmap reads a truncated ``cameras.bin`` as zeros and does not return from some damaged ``points3D.bin`` or ``frames.bin``. Therefore the records of binary
files are counted before pycolmap reads them. The format follows COLMAP's ``src/colmap/scene/reconstruction_io_binary.cc``.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

from advnerf_core.data.scan_folder import model_suffix
from calibration.photo_model import ReconstructionError

_SHOWN = 6


def model_folders(path: Path) -> dict[str, Path]:
    """Folders of COLMAP models by name: the folder itself, or those in it or in its ``sparse`` folder.

    Raises:
        ReconstructionError: The folder has no model.
    """
    for folder in (path, path / "sparse"):
        if model_suffix(folder):
            return {folder.name or ".": folder}
        inside = {
            each.name: each for each in sorted(folder.glob("*"), key=_number_first) if model_suffix(each)
        }
        if inside:
            return inside
    there = sorted(each.name for each in path.iterdir())
    listed = ", ".join(there[:_SHOWN]) + (", ..." if len(there) > _SHOWN else "")
    raise ReconstructionError(
        f"expected cameras, images and points3D (.bin or .txt) in {path}, in folders 0, 1, ... of it, or in its folder sparse; "
        f"got {listed or 'an empty folder'}; give the folder that COLMAP's mapper wrote"
    )


def _number_first(folder: Path) -> tuple[int, str]:
    return (int(folder.name) if re.fullmatch(r"\d{1,9}", folder.name) else 1 << 30, folder.name)


def check_binary_files(folder: Path) -> None:
    """Raise for binary files of a model that end too early or too late; text files are not checked.

    Raises:
        ReconstructionError: A file is damaged.
    """
    if model_suffix(folder) != ".bin":
        return
    for name, end_of_record in _RECORDS.items():
        file = folder / f"{name}.bin"
        if name in _SINCE_RIGS and not file.exists():
            continue
        data = file.read_bytes()
        try:
            (count,), at = struct.unpack_from("<Q", data), 8
            for _ in range(count):
                at = end_of_record(data, at)
        except (struct.error, ValueError, IndexError):
            at = len(data) + 1
        if at != len(data):
            raise ReconstructionError(
                f"expected a complete {file}, got {len(data)} bytes that are {'too few' if at > len(data) else 'too many'} or damaged; "
                "copy the file again, or export the model again"
            )


def _camera(data: bytes, at: int) -> int:
    import pycolmap

    _, model = struct.unpack_from("<Ii", data, at)
    any_of_it = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return at + 24 + 8 * len(any_of_it.params)


def _image(data: bytes, at: int) -> int:
    name_end = data.index(b"\0", at + 64)
    (points,) = struct.unpack_from("<Q", data, name_end + 1)
    return _within(data, name_end + 9 + 24 * points)


def _point(data: bytes, at: int) -> int:
    (views,) = struct.unpack_from("<Q", data, at + 43)
    return _within(data, at + 51 + 8 * views)


def _rig(data: bytes, at: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 8 + 8 * (sensors > 0)  # the reference sensor has no pose
    for _ in range(1, sensors):
        at += 9 + 56 * bool(data[at + 8])
    return _within(data, at)


def _frame(data: bytes, at: int) -> int:
    (images,) = struct.unpack_from("<I", data, at + 64)
    return _within(data, at + 68 + 16 * images)


def _within(data: bytes, end: int) -> int:
    if end > len(data):
        raise ValueError("a record ends behind the file")
    return end


# The end of a record that begins at a byte. Models from before COLMAP 3.12 have no rigs and frames.
_RECORDS: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
_SINCE_RIGS = ("rigs", "frames")
