"""Splats whose images or values are known, and their files."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.splats.gaussians import COLOUR_OFFSET, CONSTANT_BASIS, GaussianSplats

Colours = Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]


def gaussians(
    means: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    colours: ArrayLike,
    rotations: ArrayLike | None = None,
    bands: int = 1,
) -> GaussianSplats:
    """Gaussians with plain colours ``[N, 3]``."""
    count = len(np.asarray(means))
    harmonics = np.zeros((count, bands**2, 3))
    harmonics[:, 0] = (np.asarray(colours, np.float64) - COLOUR_OFFSET) / CONSTANT_BASIS
    if rotations is None:
        rotations = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    scales = np.broadcast_to(scales, (count, 3))
    parts = (means, scales, rotations, np.broadcast_to(opacities, count), harmonics)
    return GaussianSplats(*(np.ascontiguousarray(part, np.float32) for part in parts))


def random_splats(count: int, seed: int = 0, bands: int = 4, spread_m: float = 1.0) -> GaussianSplats:
    """Gaussians of any shape, turn and colour, in a cloud."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    made = gaussians(
        rng.normal(0.0, spread_m, (count, 3)),
        np.exp(rng.normal(np.log(0.06 * spread_m), 0.6, (count, 3))),
        rng.uniform(0.05, 1.0, count),
        rng.uniform(0.1, 0.9, (count, 3)),
        turns,
        bands,
    )
    made.harmonics[:, 1:] = rng.normal(0.0, 0.1, made.harmonics[:, 1:].shape)
    return made


def room(
    count: int,
    seed: int = 0,
    size_m: tuple[float, float, float] = (4.0, 4.0, 2.4),
    colour: Colours | None = None,
) -> GaussianSplats:
    """Flat Gaussians on the inner walls of a box around the origin; ``colour(points, face)`` in 0..1, or a smooth pattern."""
    rng = np.random.default_rng(seed)
    size = np.array(size_m)
    areas = np.repeat([size[1] * size[2], size[0] * size[2], size[0] * size[1]], 2)
    face = rng.choice(6, count, p=areas / areas.sum())
    axis, rows = face // 2, np.arange(count)
    points = rng.uniform(-0.5, 0.5, (count, 3)) * size
    points[rows, axis] = (face % 2 - 0.5) * size[axis]
    wide = 1.2 * np.sqrt(areas.sum() / count)
    scales = np.full((count, 3), wide)
    scales[rows, axis] = 0.1 * wide
    return gaussians(points, scales, 0.9, (colour or wall_colours)(points, face))


def wall_colours(points: NDArray[Any], face: NDArray[Any]) -> NDArray[Any]:
    """A smooth pattern, another on each wall."""
    waves = [np.sin(2.0 * points[:, k] + face) * np.cos(1.5 * points[:, (k + 1) % 3]) for k in range(3)]
    return 0.5 + 0.35 * np.stack(waves, axis=1)


def splat_bytes(splats: GaussianSplats) -> bytes:
    """The content of a .splat file."""
    rgb = CONSTANT_BASIS * splats.harmonics[:, 0] + COLOUR_OFFSET
    rgba = np.clip(np.round(255.0 * np.concatenate([rgb, splats.opacities[:, None]], axis=1)), 0, 255).astype(
        np.uint8
    )
    turns = np.clip(np.round(splats.rotations * 128.0 + 128.0), 0, 255).astype(np.uint8)
    return b"".join(
        struct.pack("<3f3f", *mean, *scale) + colour.tobytes() + turn.tobytes()
        for mean, scale, colour, turn in zip(splats.means_m, splats.scales_m, rgba, turns, strict=True)
    )


def glb_bytes(
    splats: GaussianSplats,
    change: Callable[[Any], object] = lambda tree: None,
    arrays: Mapping[str, NDArray[Any]] | None = None,
    matrix: NDArray[Any] | None = None,
) -> bytes:
    """The content of a .glb file with the extension; ``change`` edits its JSON, ``arrays`` replaces attributes."""
    prefix = "KHR_gaussian_splatting:"
    w, x, y, z = splats.rotations.T
    attributes = {
        "POSITION": splats.means_m,
        f"{prefix}ROTATION": np.stack([x, y, z, w], axis=1),
        f"{prefix}SCALE": splats.scales_m,
        f"{prefix}OPACITY": splats.opacities,
    }
    for band in range(splats.bands):
        for n in range(2 * band + 1):
            attributes[f"{prefix}SH_DEGREE_{band}_COEF_{n}"] = splats.harmonics[:, band**2 + n]
    attributes |= arrays or {}
    kinds = {"f": 5126, "b": 5120, "B": 5121, "h": 5122, "H": 5123}
    blob, index = b"", dict[str, int]()
    views, accessors = list[Any](), list[Any]()
    for name, array in attributes.items():
        array = (
            np.ascontiguousarray(array)
            if array.dtype.kind != "f"
            else np.ascontiguousarray(array, np.float32)
        )
        index[name] = len(accessors)
        shape = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if array.ndim == 1 else array.shape[1]]
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes})
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": kinds[array.dtype.char],
                "count": len(array),
                "type": shape,
                "normalized": array.dtype.kind != "f",
            }
        )
        blob += array.tobytes() + b"\0" * (-array.nbytes % 4)
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    node = {"mesh": 0} if matrix is None else {"mesh": 0, "matrix": list(np.asarray(matrix).T.reshape(-1))}
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [
            {
                "primitives": [
                    {"mode": 0, "attributes": index, "extensions": {"KHR_gaussian_splatting": extension}}
                ]
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def write_ply(path: Path, splats: GaussianSplats, compressed: bool = False) -> Path:
    """A file of gsply; a compressed one gets another name, which is returned."""
    # Not its plywrite, which imports the compiler of torch, to see whether it is given tensors.
    from gsply import GSData
    from gsply.writer import write_compressed, write_uncompressed

    with np.errstate(divide="ignore"):
        logits = np.log(splats.opacities / (1.0 - splats.opacities))
        parts = (splats.means_m, np.log(splats.scales_m), splats.rotations, logits, splats.harmonics[:, 0])
    rest = splats.harmonics[:, 1:] if splats.bands > 1 else None
    if compressed:
        path = path.with_name(f"{path.stem}.compressed.ply")
        write_compressed(path, *parts, rest)
    else:
        write_uncompressed(path, GSData.from_arrays(*parts, rest, format="ply"))
    return path


def write_spz(path: Path, splats: GaussianSplats, version: int = 3) -> Path:
    """A file of gsply."""
    import gsply

    logits = np.log(splats.opacities / (1.0 - splats.opacities))
    rest = splats.harmonics[:, 1:] if splats.bands > 1 else None
    data = gsply.GSData.from_arrays(
        means=splats.means_m,
        scales=np.log(splats.scales_m),
        quats=splats.rotations,
        opacities=logits,
        sh0=splats.harmonics[:, 0],
        shN=rest,
        format="ply",
    )
    gsply.write_spz(path, data, version=version)
    return path


def sample_files(folder: Path) -> dict[str, bytes]:
    """The bytes of one small file of each format, by suffix."""
    splats = random_splats(12, bands=2)
    return {
        "ply": write_ply(folder / "a.ply", splats).read_bytes(),
        "compressed.ply": write_ply(folder / "b.ply", splats, compressed=True).read_bytes(),
        "spz": write_spz(folder / "a.spz", splats).read_bytes(),
        "v4.spz": write_spz(folder / "b.spz", splats, 4).read_bytes(),
        "splat": splat_bytes(splats),
        "glb": glb_bytes(splats),
    }
