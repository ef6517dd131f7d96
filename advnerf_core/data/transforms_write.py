"""Writes ``transforms.json`` files that nerfstudio and Instant-NGP can read too."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.data.lens import Lens
from advnerf_core.files import write_json
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Pinhole

T = TypeVar("T")


def write_transforms(
    path: str | Path,
    image_paths: Sequence[str | Path],
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole | Sequence[Pinhole],
    *,
    lens: Lens | Sequence[Lens] | None = None,
    camera_ids: Sequence[str] | None = None,
    masks: Sequence[str | Path | None] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Write a ``transforms.json``, whole or not at all; images are written by the caller.

    Args:
        image_paths: Image files: absolute, or relative to the file's folder.
        T_world_from_camera: ``[N, 4, 4]``, OpenCV axes.
        pinhole: One for all images, or one each.
        lens: Distortion of all images, or one each; None for none.
        camera_ids: Id of each image's camera.
        masks: Mask of each image, or None; as ``image_paths``.
        extra: Further data for the top of the file (JSON types).
    """
    path, poses, count = Path(path), np.asarray(T_world_from_camera, np.float64), len(image_paths)
    if poses.shape != (count, 4, 4):
        raise ValueError(f"expected poses [{count}, 4, 4], one per image, got {poses.shape}")
    if not np.isfinite(poses).all():
        raise ValueError("expected finite poses")
    pinholes, lenses = _each(pinhole, Pinhole, count), _each(Lens() if lens is None else lens, Lens, count)
    ids = [None] * count if camera_ids is None else list(camera_ids)
    if len(ids) != count:
        raise ValueError(f"expected {count} camera ids, one per image, got {len(ids)}")
    masked = [None] * count if masks is None else list(masks)
    if len(masked) != count:
        raise ValueError(f"expected {count} masks or Nones, one per image, got {len(masked)}")
    intrinsics = [_intrinsics(p, each) for p, each in zip(pinholes, lenses, strict=True)]
    shared = intrinsics[0] if intrinsics and all(values == intrinsics[0] for values in intrinsics) else {}
    content = {"camera_model": "OPENCV", **shared, **dict(extra or {})}
    frames = []
    for index, image in enumerate(image_paths):
        frame: dict[str, Any] = {"file_path": _relative(Path(image), path.parent)}
        if ids[index] is not None:
            frame["camera_id"] = ids[index]
        if (mask := masked[index]) is not None:
            frame["mask_path"] = _relative(Path(mask), path.parent)
        frame["transform_matrix"] = (poses[index] @ OPENGL_FROM_OPENCV).tolist()
        frames.append({**frame, **({} if shared else intrinsics[index])})
    write_json(path, {**content, "frames": frames})


def _each(value: Any, kind: type[T], count: int) -> list[T]:
    values = [value] * count if isinstance(value, kind) else list(value)
    if len(values) != count:
        raise ValueError(f"expected one {kind.__name__} or one for each of {count} images, got {len(values)}")
    return values


def _relative(image: Path, folder: Path) -> str:
    """Relative to the file's folder even if the image lies outside, so that both can move together."""
    return (
        Path(os.path.relpath(image, folder.absolute())).as_posix()
        if image.is_absolute()
        else image.as_posix()
    )


def _intrinsics(p: Pinhole, lens: Lens) -> dict[str, Any]:
    values: dict[str, Any] = {"w": p.width, "h": p.height, "fl_x": p.fx, "fl_y": p.fy, "cx": p.cx, "cy": p.cy}
    if lens.fisheye:
        keys, values["camera_model"] = ("k1", "k2", "k3", "k4"), "OPENCV_FISHEYE"
    else:
        keys = ("k1", "k2", "p1", "p2", "k3")  # type: ignore[assignment]
    if not lens.is_ideal:
        values.update(zip(keys, lens.coefficients, strict=True))
    return values
