"""Gaussians in glTF files with the extension KHR_gaussian_splatting (Khronos, ratified 2026), in the file's scene: metres, y up.

Quantised values are read as the extension defines them. Drafts before the ratified text stored logarithms of sizes; these are known by
negative numbers, which the ratified text forbids.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.similarity import Similarity
from advnerf_core.fields.spherical_harmonics import MAX_BANDS
from advnerf_core.geometry import Array, make_transform
from advnerf_core.splats.gaussians import FOR_A_MESH, GaussianSplats, SplatError

EXTENSION = "KHR_gaussian_splatting"
_PREFIX = f"{EXTENSION}:"
_SPACES = ("srgb_rec709_display", "BT.709")  # the second in a draft
_HARMONICS = [f"SH_DEGREE_{band}_COEF_{n}" for band in range(MAX_BANDS) for n in range(2 * band + 1)]
_NEEDED = (
    "POSITION",
    f"{_PREFIX}ROTATION",
    f"{_PREFIX}SCALE",
    f"{_PREFIX}OPACITY",
    f"{_PREFIX}{_HARMONICS[0]}",
)
# Turns of a node's axes may be this far from a similarity, as drawn with rounded numbers.
_TOLERANCE = 1e-3
Parts = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]


def read_gltf(path: Path) -> Parts:
    """Means, sizes, quaternions ``w, x, y, z``, opacities and harmonics of all splats of a GLB file.

    Raises:
        SplatError: The file has no splats, or uses what is not supported.
        ValueError: The data are damaged.
    """
    import trimesh
    from trimesh.exchange.gltf.extensions import register_handler

    found: list[tuple[dict[str, Any], dict[str, NDArray[Any]]]] = []

    broken: list[Exception] = []

    def take(context: dict[str, Any]) -> None:
        """Keep the arrays of a primitive; in the scene one point stands for it, whose x is its number."""
        try:
            primitive, accessors = context["primitive"], context["accessors"]
            arrays = {name: np.asarray(accessors[index]) for name, index in primitive["attributes"].items()}
        except (LookupError, TypeError, AttributeError) as error:  # trimesh would only log it
            broken.append(error)
            return
        accessors.append(np.array([[len(found), 0.0, 0.0]], np.float32))
        primitive["attributes"] = {"POSITION": len(accessors) - 1}
        found.append((context["data"], arrays))

    register_handler(EXTENSION, "primitive_preprocess")(take)
    try:
        scene = trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type="glb", process=False)
    except SplatError:
        raise
    except Exception as error:  # trimesh's readers raise any exception
        raise ValueError(f"{type(error).__name__}: {error}") from error
    finally:
        register_handler(EXTENSION, "primitive_preprocess")(lambda context: None)
    if broken:
        raise ValueError(f"attributes that are not there ({broken[0]})")
    if not found:
        raise SplatError(
            f"expected Gaussians ({EXTENSION}) in {path}, got none; give the splat instead of a point cloud; {FOR_A_MESH}"
        )
    parts: list[GaussianSplats] = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.PointCloud) and len(geometry.vertices) == 1:
            data, arrays = found[int(geometry.vertices[0, 0])]
            parts.append(
                _of_primitive(path, data, arrays).moved(_similarity(path, np.asarray(transform, np.float64)))
            )
    fewest = min((part.harmonics.shape[1] for part in parts), default=1)
    merged = [np.concatenate(each) for each in zip(*(_values(part, fewest) for part in parts), strict=True)]
    if not merged:
        raise SplatError(f"expected a node with Gaussians in the scene of {path}, got none")
    return merged[0], merged[1], merged[2], merged[3], merged[4]


def _values(part: GaussianSplats, harmonics: int) -> Parts:
    return part.means_m, part.scales_m, part.rotations, part.opacities, part.harmonics[:, :harmonics]


def _of_primitive(path: Path, data: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> GaussianSplats:
    if data.get("extensions"):
        raise SplatError(
            f"expected Gaussians without compression in {path}, got {', '.join(data['extensions'])}; export them without, or as .spz"
        )
    if data.get("kernel", "ellipse") != "ellipse" or data.get("colorSpace", _SPACES[0]) not in _SPACES:
        raise SplatError(
            f"expected the kernel ellipse and the colour space {_SPACES[0]} in {path}, got {data.get('kernel')} and {data.get('colorSpace')}"
        )
    if missing := [name for name in _NEEDED if name not in arrays]:
        raise SplatError(
            f"expected the attributes {', '.join(_NEEDED)} in {path}, without {', '.join(missing)}"
        )
    scales = arrays[f"{_PREFIX}SCALE"]
    if scales.dtype.kind != "f":
        raise SplatError(
            f"expected sizes of the type float in {path}, got {scales.dtype}; export it without quantisation"
        )
    scales = np.asarray(scales, np.float64)
    if (scales < 0.0).any():
        scales = np.exp(scales)
    bands = max(
        b
        for b in range(1, MAX_BANDS + 1)
        if all(f"{_PREFIX}{name}" in arrays for name in _HARMONICS[: b * b])
    )
    harmonics = np.stack([arrays[f"{_PREFIX}{name}"] for name in _HARMONICS[: bands**2]], axis=1)
    x, y, z, w = _normalised(arrays[f"{_PREFIX}ROTATION"]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        rotations = np.stack([w, x, y, z], axis=1) / np.sqrt(w * w + x * x + y * y + z * z)[:, None]
    opacities = _normalised(arrays[f"{_PREFIX}OPACITY"]).reshape(-1)
    kept = np.isfinite(rotations).all(axis=1)  # a quaternion without length cannot be turned
    values = (arrays["POSITION"], scales, rotations, opacities, harmonics)
    return GaussianSplats(*(np.asarray(value, np.float32)[kept] for value in values))


def _normalised(values: NDArray[Any]) -> NDArray[np.float64]:
    """Integers as glTF's normalized numbers."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    return np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1.0)


def _similarity(path: Path, transform: Array) -> Similarity:
    """A node's transform.

    Raises:
        SplatError: The transform shears, mirrors or stretches.
    """
    linear = transform[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    turn = linear / scale if scale > 0.0 else linear
    if not np.allclose(turn @ turn.T, np.eye(3), atol=_TOLERANCE) or scale <= 0.0:
        raise SplatError(
            f"expected nodes in {path} that move, turn and scale evenly, got another transform; apply it before the export"
        )
    return Similarity(scale, make_transform(turn, transform[:3, 3]))
