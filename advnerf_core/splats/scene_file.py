"""Scene files of splats, and functions for a scene file of either kind: learned field or splat."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.files import read_tensors, write_tensors
from advnerf_core.geometry import Pinhole
from advnerf_core.scene.bake import bake
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.field import SceneFieldConfig, SceneFileError, load_scene, load_scene_config
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.splats.bake import bake_splats
from advnerf_core.splats.gaussians import GaussianSplats
from advnerf_core.splats.renderer import Corner, SplatRenderer

FORMAT = "advnerf-splat-1"


def save_splat_scene(path: Path, renderer: SplatRenderer, metadata: dict[str, Any] | None = None) -> str:
    """Write a splat in the world to one ``.safetensors`` file, atomically. Harmonics are stored in half precision.

    Args:
        metadata: JSON values: where it came from.

    Returns:
        The scene's hash.
    """
    parts: dict[str, NDArray[Any]] = dict(vars(renderer.splats))
    parts["harmonics"] = np.clip(parts["harmonics"], -6e4, 6e4).astype(np.float16)
    content = {"box": renderer.box, "behind": renderer.behind, "near_m": renderer.near_m}
    digest = hashlib.sha256(json.dumps(content).encode())
    for name, part in sorted(parts.items()):
        digest.update(name.encode() + part.tobytes())
    header = {
        "format": FORMAT,
        "content": json.dumps(content),
        "scene_hash": digest.hexdigest()[:16],
        "metadata": json.dumps(metadata or {}),
    }
    write_tensors(path, "numpy", parts, header)
    return header["scene_hash"]


def load_splat_scene(path: Path) -> tuple[SplatRenderer, dict[str, Any]]:
    """The renderer of a file of `save_splat_scene`, and its metadata (with ``scene_hash``).

    Raises:
        SceneFileError: The file is missing, damaged, or of another kind.
    """
    header = _header(path)
    box, content = _content(path, header)
    try:
        parts = {name: part.astype(np.float32) for name, part in read_tensors(path, "numpy")[1].items()}
        renderer = SplatRenderer(
            GaussianSplats(**parts), tuple(content["behind"]), near_m=content["near_m"], box=box
        )
        metadata = {**json.loads(header["metadata"]), "scene_hash": header["scene_hash"]}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise _damaged(path, error) from error
    return renderer, metadata


def is_splat_scene(path: Path) -> bool:
    """Whether a scene file holds a splat; a file that is missing or damaged does not."""
    try:
        return _header(path).get("format") == FORMAT
    except SceneFileError:
        return False


def load_renderer(path: Path, interval_scale: float = 1.0) -> FieldRenderer | SplatRenderer:
    """The renderer of a scene file of either kind; ``interval_scale`` as in `FieldRenderer.from_file`, for fields.

    Raises:
        SceneFileError: The file is missing, damaged, or of another kind.
    """
    if is_splat_scene(path):
        return load_splat_scene(path)[0]
    return FieldRenderer.from_file(path, interval_scale=interval_scale)


def load_box(path: Path) -> SceneFieldConfig:
    """The box of a scene file of either kind; the other sizes are a field's.

    Raises:
        SceneFileError: The file is missing, damaged, or of another kind.
    """
    header = _header(path)
    if header.get("format") != FORMAT:
        return load_scene_config(path)
    return SceneFieldConfig(*_content(path, header)[0])


def load_hash(path: Path) -> str:
    """The content hash of a scene file of either kind.

    Raises:
        SceneFileError: The file is missing, damaged, or of another kind.
    """
    header = _header(path)
    if header.get("format") != FORMAT:
        return str(load_scene(path)[2]["scene_hash"])
    return header.get("scene_hash", "")


def bake_scene(
    source: FieldRenderer | SplatRenderer, T_world_from_camera: ArrayLike, pinhole: Pinhole
) -> BakedScene:
    """Bake a scene of either kind for views like ``T_world_from_camera [N, 4, 4]``.

    Raises:
        NotBakedError: The scene cannot be baked.
    """
    if isinstance(source, SplatRenderer):
        return bake_splats(source, T_world_from_camera, pinhole)
    return bake(source, T_world_from_camera, pinhole)


def _header(path: Path) -> dict[str, str]:
    try:
        return read_tensors(path, "numpy", ())[0]
    except (OSError, ValueError) as error:
        raise SceneFileError(
            f"expected a scene file at {path}, got: {error}; make the scene again"
        ) from error


def _content(path: Path, header: dict[str, str]) -> tuple[tuple[Corner, Corner], dict[str, Any]]:
    """The box, and what else the header of a splat says."""
    if header.get("format") != FORMAT:
        raise SceneFileError(
            f"expected format {FORMAT} in {path}, got {header.get('format')}; run 'advnerf scene from-splat' again"
        )
    try:
        content: dict[str, Any] = json.loads(header["content"])
        low, high = ((float(x), float(y), float(z)) for x, y, z in content["box"])
    except (ValueError, TypeError, KeyError) as error:
        raise _damaged(path, error) from error
    return (low, high), content


def _damaged(path: Path, error: Exception) -> SceneFileError:
    return SceneFileError(f"expected a splat in {path}, got: {error}; run 'advnerf scene from-splat' again")
