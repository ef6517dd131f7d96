"""Reads data sets of nerfstudio, Instant-NGP and blender as scans, so that they can be put upright and get metres.

Format: https://docs.nerf.studio/quickstart/data_conventions.html. ``applied_transform`` and then ``applied_scale`` took COLMAP's world to the file's; ``dataparser_transforms.json``
takes COLMAP's world to that of a trained model: ``scale * (transform x)``, where ``scale`` contains ``applied_scale``.
"""

from __future__ import annotations

import os
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.image_files import read_bytes
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.transforms import load_transforms
from advnerf_core.documents import read_json
from advnerf_core.geometry import Array, invert_transform, make_transform
from calibration.photo_model import LeftOut, Registered
from calibration.scans.scan import (
    Picture,
    Scan,
    ScanError,
    ScanOptions,
    lens_of,
    model_of,
    number,
    pose_of,
    spread,
)

OPTIONS: tuple[str, ...] = ()
_DATAPARSER = "dataparser_transforms.json"
_UNKNOWN = "unknown: lengths are in the file's unit; if that is not the metre, give --length, --positions or --marker"


def read(path: Path, options: ScanOptions) -> Scan:
    """Read a data set, or the file of one.

    Raises:
        DatasetError: The file cannot be used.
        ScanError: Too few images, or a lens whose distortion cannot be undone.
    """
    listed = load_transforms(path)
    found, pictures = list[Registered](), dict[str, Picture]()
    for index in spread(len(listed.frames), options.most):
        frame = listed.frames[index]
        name = _name(frame.path, listed.file.parent if listed.file else path, pictures)
        lens = lens_of(frame.pinhole, frame.lens, str(frame.path))
        camera = frame.camera_id or "camera"
        found.append(Registered(name, camera, frame.T_world_from_camera, frame.pinhole, lens))
        pictures[name] = _picture(name, frame)
    left_out = [LeftOut(each.name, f"{each} is not there") for each in listed.missing]
    content = read_json(listed.file) if listed.file else {}
    folder = listed.file.parent if listed.file else path
    points, remark = _points(folder, content)
    model = model_of(found, left_out, path, points)
    return Scan(model, pictures, _UNKNOWN, facts={**_facts(folder, content), **remark})


def _picture(name: str, frame: PosedImage) -> Picture:
    content = partial(read_bytes, frame.path)
    return Picture(name, content, frame.pinhole.width, frame.pinhole.height, None, frame.mask, frame.split)


def _name(file: Path, folder: Path, taken: dict[str, Picture]) -> str:
    """Name of an image in the data set: relative to the folder, if it lies there."""
    written, root = Path(os.path.normpath(file)), Path(os.path.normpath(folder))
    inside = written.is_relative_to(root)
    name = written.relative_to(root).as_posix() if inside else f"{written.parent.name}/{written.name}"
    name = name.removeprefix("images/")
    if name in taken:
        raise ScanError(f"{file}: expected images of different names, got {name} twice; rename one of them")
    return name


def _points(folder: Path, content: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
    """Points ``[M, 3]`` of the file that the data set names, and a remark for the report if it cannot be read."""
    name, none = content.get("ply_file_path"), np.zeros((0, 3))
    if not isinstance(name, str):
        return none, {}
    try:
        import trimesh

        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            cloud: Any = trimesh.load(folder / name, file_type="ply", process=False)
        points = np.asarray(cloud.vertices, np.float64).reshape(-1, 3)
    except Exception as error:  # trimesh is not installed, or meets a damaged file; points are a help only
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return none, {"points": f"{name} cannot be read ({reason:.80}); ground and box come without it"}
    return points[np.isfinite(points).all(axis=1)], {}


def _facts(folder: Path, content: dict[str, Any]) -> dict[str, Any]:
    """Relations to the worlds of COLMAP and of a trained model, from its coordinates to the file's."""
    applied, size = content.get("applied_transform"), content.get("applied_scale", 1.0)
    T_file_from_colmap = np.eye(4) if applied is None else pose_of(applied, f"{folder}: applied_transform")
    file_per_colmap = _size(size, f"{folder}: applied_scale")
    facts: dict[str, Any] = {}
    if applied is not None or file_per_colmap != 1.0:
        # The file's positions are scaled after they are moved.
        facts["T_scan_from_colmap"] = make_transform(
            T_file_from_colmap[:3, :3], file_per_colmap * T_file_from_colmap[:3, 3]
        ).tolist()
        facts["scan_units_per_colmap_unit"] = file_per_colmap
    file = folder / _DATAPARSER
    if file.is_file():
        values = read_json(file)
        if not isinstance(values, dict) or "transform" not in values:
            raise ScanError(
                f"{file}: expected the keys transform and scale; copy the file from the training's folder again"
            )
        scale = _size(values.get("scale"), f"{file}: scale")
        T_model_from_colmap = pose_of(values["transform"], f"{file}: transform")
        facts["T_scan_from_dataparser"] = (
            T_file_from_colmap @ invert_transform(T_model_from_colmap)
        ).tolist()
        facts["scan_units_per_dataparser_unit"] = file_per_colmap / scale
    return facts


def _size(value: Any, where: str) -> float:
    found = number(value, where)
    if found <= 0.0:
        raise ScanError(f"{where}: expected a number above 0, got {found:g}; copy the file again")
    return found
