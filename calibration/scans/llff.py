"""Reads ``poses_bounds.npy`` of LLFF, as NeRF and its successors use it.

Format: https://github.com/Fyusion/LLFF, "Using your own poses without running COLMAP". A row for each image, in the order of their names: a pose ``[3, 5]`` whose
columns are the camera's axes down, right and backward, its position, and height, width and focal length [px]; then the nearest and farthest depth.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tokenize import TokenError

import numpy as np

from advnerf_core.data.image_files import read_bytes
from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Array, Pinhole, transform_points
from calibration.photo_model import LeftOut, Registered
from calibration.scans.scan import (
    Picture,
    Scan,
    ScanError,
    ScanOptions,
    images_in,
    model_of,
    pinhole_of,
    pose_of,
    spread,
)

OPTIONS = ("images",)
POSES = "poses_bounds.npy"
_COLUMNS = 17
_UNKNOWN = "unknown: lengths are in COLMAP's unit, not in metres; give --length, --positions or --marker"


def read(path: Path, options: ScanOptions) -> Scan:
    """Read the poses, and the images in ``images`` or in the largest ``images_N``.

    Raises:
        ScanError: The file is damaged, or has another number of rows than there are images.
    """
    rows, folder = _rows(path / POSES), options.images or _images_folder(path)
    files = images_in(folder)
    if len(files) != len(rows):
        raise ScanError(
            f"{path / POSES}: expected as many rows as images in {folder}, got {len(rows)} rows and {len(files)} images; "
            "give the images of the poses with --images, or remove the others"
        )
    found, left_out, pictures = list[Registered](), list[LeftOut](), dict[str, Picture]()
    reached: list[Array] = [np.zeros((0, 3))]
    for index in spread(len(rows), options.most):
        file, where = files[index], f"{path / POSES}: row {index}"
        try:
            one = _image(rows[index], file, where)
        except ScanError as error:
            left_out.append(LeftOut(file.name, str(error)))
            continue
        found.append(one)
        reached.append(_reached(one, rows[index, 15:]))
        pictures[file.name] = Picture(
            file.name, partial(read_bytes, file), one.pinhole.width, one.pinhole.height
        )
    model = model_of(found, left_out, path, why="as in the scan; LLFF has no distortion")
    return Scan(model, pictures, _UNKNOWN, reached=np.concatenate(reached))


def _rows(file: Path) -> Array:
    try:
        # A mapped file is checked against its size before memory is taken.
        rows = np.array(np.load(file, mmap_mode="r", allow_pickle=False))
    except (
        ValueError,
        OSError,
        EOFError,
        SyntaxError,
        TypeError,
        TokenError,
        OverflowError,
        MemoryError,
        KeyError,
    ) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ScanError(f"{file}: expected an array of numpy, got: {reason}; copy the file again") from None
    if rows.ndim != 2 or rows.shape[1] != _COLUMNS or rows.dtype.kind not in "fiu":
        raise ScanError(
            f"{file}: expected numbers [N, {_COLUMNS}], got {rows.dtype} {list(rows.shape)}; run LLFF's imgs2poses again"
        )
    return rows.astype(np.float64)


def _images_folder(path: Path) -> Path:
    reduced = sorted(path.glob("images_*"), key=lambda each: (len(each.name), each.name))
    there = [each for each in (path / "images", *reduced) if images_in(each)]
    if not there:
        raise ScanError(
            f"{path}: expected the folder images beside {POSES}, found none; put the images there, or give --images"
        )
    return there[0]


def _image(row: Array, file: Path, where: str) -> Registered:
    pose = row[:15].reshape(3, 5)
    down, right, back, position = pose[:, :4].T
    T = pose_of(np.stack([right, down, -back, position], axis=1), where)
    height, width, focal = (float(each) for each in pose[:, 4])
    pinhole = pinhole_of(width, height, (focal, focal, 0.5 * width, 0.5 * height), where)
    return Registered(file.name, "camera", T, pinhole, Lens())


def _reached(image: Registered, bounds: Array) -> Array:
    """Corners ``[8, 3]`` of the view at the nearest and at a middle depth; none if the bounds are no depths."""
    near, far = (float(each) for each in bounds)
    if not (0.0 < near <= far < np.inf):
        return np.zeros((0, 3))
    p: Pinhole = image.pinhole
    corners = np.array(
        [[((u - p.cx) / p.fx), ((v - p.cy) / p.fy), 1.0] for u in (0, p.width) for v in (0, p.height)]
    )
    depths = np.array([near, np.sqrt(near * far)])
    return transform_points(image.T_world_from_camera, (depths[:, None, None] * corners).reshape(-1, 3))
