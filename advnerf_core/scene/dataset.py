"""Posed images on disk: ``transforms.json`` as nerfstudio and Instant-NGP write it, turned into our conventions at the door.

Files have OpenGL camera axes (x right, y up, z backward) and possibly lens distortion; everything after this module has OpenCV
axes and ideal pinholes with pixel centres at +0.5.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Array, Pinhole

Rgb = NDArray[np.uint8]

_DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
_NGP_SCALE = 0.33  # Instant-NGP maps the file's coordinates into its unit cube by 0.33 x + 0.5

_LENSES = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}


class DatasetError(AdvnerfError):
    """A set of posed images cannot be used; the message names the file and what is wrong with it."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One photograph on disk.

    Attributes:
        path: The image file.
        pinhole: Intrinsics of the file as it lies on disk; None if they follow from the field of view and the file's size.
        distortion: OpenCV coefficients ``k1, k2, p1, p2, k3``.
        T_world_from_camera: Pose ``[4, 4]``, OpenCV axes.
    """

    path: Path
    pinhole: Pinhole
    distortion: tuple[float, float, float, float, float]
    T_world_from_camera: Array


@dataclass(frozen=True, eq=False)
class ImageSet:
    """Undistorted images in memory, all of one size.

    Attributes:
        rgb: ``[N, H, W, 3]`` uint8.
        pinholes: Intrinsics of each image.
        T_world_from_camera: ``[N, 4, 4]``.
    """

    rgb: Rgb
    pinholes: tuple[Pinhole, ...]
    T_world_from_camera: Array

    def __post_init__(self) -> None:
        if not len(self.rgb) == len(self.pinholes) == len(self.T_world_from_camera):
            raise ValueError(
                f"expected as many images as pinholes and poses, got {len(self.rgb)}, {len(self.pinholes)} and "
                f"{len(self.T_world_from_camera)}"
            )


@dataclass(frozen=True, eq=False)
class PosedImages:
    """What a ``transforms.json`` lists.

    Attributes:
        frames: Images that exist, in the file's order.
        missing: Listed files that do not exist.
        aabb_scale: Instant-NGP's box size, if the file has one.
    """

    frames: tuple[PosedImage, ...]
    missing: tuple[Path, ...]
    aabb_scale: float | None

    def sorted_by_name(self) -> PosedImages:
        """The same, in the order of file names."""
        return PosedImages(tuple(sorted(self.frames, key=lambda f: f.path.name)), self.missing, self.aabb_scale)

    def split(self, every: int) -> tuple[PosedImages, PosedImages]:
        """Training and held-out images: of the present order, every ``every``-th, from the first, is held out."""
        held = tuple(f for i, f in enumerate(self.frames) if i % every == 0)
        rest = tuple(f for i, f in enumerate(self.frames) if i % every != 0)
        return PosedImages(rest, self.missing, self.aabb_scale), PosedImages(held, self.missing, self.aabb_scale)

    def load(self, size: tuple[int, int] | None = None) -> ImageSet:
        """Read, undistort and resize all images.

        Args:
            size: ``(width, height)`` [px] to bring all images to by area averaging; None keeps the size on disk.
        """
        if not self.frames:
            raise DatasetError("expected at least one image to load, got none")
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            loaded = list(pool.map(lambda frame: load_image(frame, size), self.frames))
        sizes = {(p.width, p.height) for _, p in loaded}
        if len(sizes) > 1:
            raise DatasetError(f"expected images of one size, got {sorted(sizes)}; give a size to bring them to")
        poses = np.stack([frame.T_world_from_camera for frame in self.frames])
        return ImageSet(np.stack([rgb for rgb, _ in loaded]), tuple(p for _, p in loaded), poses)

    def box(self) -> tuple[Array, Array]:
        """Low and high corner of Instant-NGP's box for this file, in its world units."""
        half = 0.5 * (self.aabb_scale or 1.0) / _NGP_SCALE
        return np.full(3, -half), np.full(3, half)


def load_transforms(path: str | Path, require_all: bool = False) -> PosedImages:
    """Read a ``transforms.json``.

    Args:
        path: The file, or the folder that holds it.
        require_all: Whether a listed image that is missing is an error; otherwise it is left out and listed in ``missing``.

    Raises:
        DatasetError: Unreadable file, wrong content, or images missing.
    """
    path = Path(path)
    path = path / "transforms.json" if path.is_dir() else path
    content = _read_json(path)
    _require_known_lens(content, path)
    listed = content.get("frames")
    if not isinstance(listed, list) or not listed:
        raise DatasetError(f"expected a list 'frames' in {path}, got {type(listed).__name__} without entries")
    frames, missing = [], []
    for number, entry in enumerate(listed):
        try:
            image = _image_path(path.parent, str(entry["file_path"]))
            if image is None:
                missing.append(path.parent / str(entry["file_path"]))
                continue
            frames.append(_frame(image, {**content, **entry}))
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"frame {number} of {path} cannot be used: {error!r}") from error
    if missing and (require_all or not frames):
        raise DatasetError(
            f"expected {len(listed)} images listed in {path}, {len(missing)} are missing, the first is {missing[0]}; "
            "put the images there, or take the entries out of the file"
        )
    scale = content.get("aabb_scale")
    return PosedImages(tuple(frames), tuple(missing), None if scale is None else float(scale))


def write_transforms(
    path: str | Path,
    image_paths: Sequence[str | Path],
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole | Sequence[Pinhole],
    aabb_scale: float | None = None,
) -> None:
    """Write a ``transforms.json``; images are written by the caller.

    Args:
        path: The file.
        image_paths: Image files, in the file's folder or relative to it.
        T_world_from_camera: ``[N, 4, 4]``, OpenCV axes.
        pinhole: One for all images, or one each.
        aabb_scale: Instant-NGP's box size.
    """
    path, poses = Path(path), np.asarray(T_world_from_camera, np.float64)
    if poses.shape != (len(image_paths), 4, 4):
        raise ValueError(f"expected poses [{len(image_paths)}, 4, 4], one per image, got {poses.shape}")
    content: dict[str, Any] = {"camera_model": "OPENCV"}
    if isinstance(pinhole, Pinhole):
        content.update(_intrinsics(pinhole))
    if aabb_scale is not None:
        content["aabb_scale"] = aabb_scale
    frames = []
    for index, image in enumerate(image_paths):
        relative = Path(image).relative_to(path.parent) if Path(image).is_absolute() else Path(image)
        own = {} if isinstance(pinhole, Pinhole) else _intrinsics(pinhole[index])
        matrix = (poses[index] @ OPENGL_FROM_OPENCV).tolist()
        frames.append({"file_path": relative.as_posix(), "transform_matrix": matrix, **own})
    write_atomically(path, json.dumps({**content, "frames": frames}, indent=1))


def load_image(frame: PosedImage, size: tuple[int, int] | None = None) -> tuple[Rgb, Pinhole]:
    """Read one image, undistort it and bring it to ``size`` (width, height); returns it with its intrinsics.

    Undistortion keeps the largest window without missing pixels, so intrinsics change a little with it.
    """
    read = cv2.imread(str(frame.path), cv2.IMREAD_COLOR)
    if read is None:
        raise DatasetError(f"expected a readable image, got {frame.path}; it may be damaged, so copy it again")
    bgr: Rgb = np.asarray(read, np.uint8)
    height, width = bgr.shape[:2]
    pinhole = frame.pinhole.resized(width, height)
    if any(frame.distortion):
        bgr, pinhole = _undistort(bgr, pinhole, np.array(frame.distortion))
    if size is not None and size != (width, height):
        shrinks = size[0] <= width and size[1] <= height
        bgr = np.asarray(cv2.resize(bgr, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)
        pinhole = pinhole.resized(*size)
    return np.ascontiguousarray(bgr[..., ::-1], dtype=np.uint8), pinhole


def _undistort(bgr: Rgb, pinhole: Pinhole, coefficients: Array) -> tuple[Rgb, Pinhole]:
    size = (pinhole.width, pinhole.height)
    matrix = pinhole.matrix.copy()
    matrix[:2, 2] -= 0.5  # OpenCV counts pixel centres from 0
    ideal, _ = cv2.getOptimalNewCameraMatrix(matrix, coefficients, size, 0.0)
    maps = cv2.initUndistortRectifyMap(matrix, coefficients, np.eye(3), ideal, size, cv2.CV_32FC1)
    straight = cv2.remap(bgr, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    fx, fy, cx, cy = (float(v) for v in (ideal[0, 0], ideal[1, 1], ideal[0, 2] + 0.5, ideal[1, 2] + 0.5))
    return np.asarray(straight, np.uint8), Pinhole(*size, fx, fy, cx, cy)


def _require_known_lens(content: dict[str, Any], path: Path) -> None:
    """Refuse a lens whose coefficients mean something else: read as OpenCV's they would bend the scene silently."""
    models = {str(entry.get("camera_model", "OPENCV")) for entry in (content, *_frames_of(content))}
    if content.get("is_fisheye") or not models <= _LENSES:
        raise DatasetError(
            f"expected camera_model {' or '.join(sorted(_LENSES))} in {path}, got {', '.join(sorted(models - _LENSES)) or 'a fisheye'}; "
            "undistort the images first"
        )


def _frames_of(content: dict[str, Any]) -> list[dict[str, Any]]:
    frames = content.get("frames")
    return [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise DatasetError(f"expected a transforms.json at {path}, got: {error.strerror}") from error
    except ValueError as error:
        raise DatasetError(f"expected JSON in {path}, got: {error}") from error
    if not isinstance(content, dict):
        raise DatasetError(f"expected a JSON object in {path}, got {type(content).__name__}")
    return content


def _image_path(folder: Path, name: str) -> Path | None:
    candidates: Iterable[Path] = (folder / name, *(folder / f"{name}{suffix}" for suffix in (".png", ".jpg", ".jpeg")))
    return next((c for c in candidates if c.is_file()), None)


def _frame(image: Path, values: dict[str, Any]) -> PosedImage:
    matrix = np.array(values["transform_matrix"], np.float64)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"expected a finite transform_matrix [4, 4], got shape {matrix.shape}")
    # Files in the wild carry rotations rounded to a few digits; the nearest rotation keeps rays of unit length.
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vt
    k = [float(values.get(key, 0.0)) for key in _DISTORTION_KEYS]
    return PosedImage(image, _pinhole(image, values), (k[0], k[1], k[2], k[3], k[4]), matrix @ OPENGL_FROM_OPENCV)


def _pinhole(image: Path, values: dict[str, Any]) -> Pinhole:
    if "w" in values and "h" in values:
        width, height = int(values["w"]), int(values["h"])
    else:
        read = cv2.imread(str(image), cv2.IMREAD_COLOR)
        if read is None:
            raise ValueError(f"expected a readable image, got {image}")
        height, width = read.shape[:2]
    if "fl_x" in values:
        fx = float(values["fl_x"])
    elif "camera_angle_x" in values:
        fx = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
    else:
        raise KeyError("fl_x or camera_angle_x")
    fy = float(values.get("fl_y", fx))
    return Pinhole(width, height, fx, fy, float(values.get("cx", 0.5 * width)), float(values.get("cy", 0.5 * height)))


def _intrinsics(p: Pinhole) -> dict[str, float]:
    return {"w": p.width, "h": p.height, "fl_x": p.fx, "fl_y": p.fy, "cx": p.cx, "cy": p.cy}
