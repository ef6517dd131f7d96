"""Readers of splat files: ``.ply`` (also PlayCanvas's compressed one), ``.spz``, ``.splat`` and ``KHR_gaussian_splatting`` in ``.glb``.

Gaussians come out in the file's own coordinates and unit. Lengths in a file are checked before memory is taken for them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.splats.gaussians import (
    COLOUR_OFFSET,
    CONSTANT_BASIS,
    FOR_A_MESH,
    GaussianSplats,
    SplatError,
)

MOST_GAUSSIANS = 20_000_000
_RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)  # .splat
_HEADER_BYTES = 1 << 16  # of a PLY file; the usual ones have two thousand
_SIZES = {
    "char": 1,
    "uchar": 1,
    "int8": 1,
    "uint8": 1,
    "short": 2,
    "ushort": 2,
    "int": 4,
    "uint": 4,
    "float": 4,
    "float32": 4,
    "double": 8,
}
_CHUNK = 256  # Gaussians of a chunk of a compressed PLY file
_SPZ_MAGIC, _SPZ_HEADER, _SPZ_MOST_BYTES = b"NGSP", 16, 65  # bytes of a Gaussian


def read_splats(path: Path) -> GaussianSplats:
    """Read a splat file by its suffix.

    Raises:
        SplatError: The file is missing, damaged, of another kind, or has no Gaussians.
    """
    readers: dict[str, Callable[[Path], GaussianSplats]] = {
        ".ply": _ply,
        ".spz": _spz,
        ".splat": _splat,
        ".glb": _glb,
    }
    if path.suffix.lower() not in readers:
        raise SplatError(f"expected a splat file {', '.join(readers)}, got {path}; {FOR_A_MESH}")
    if not path.is_file():
        raise SplatError(f"expected a splat file at {path}, found none")
    try:
        # Damaged files hold any numbers: the logistic function of a large one is 0 or 1.
        with np.errstate(over="ignore", invalid="ignore"):
            found = readers[path.suffix.lower()](path)
    except (SplatError, ImportError):
        raise
    except Exception as error:  # readers of damaged files raise any exception
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise SplatError(
            f"expected {path} to be a splat, got a damaged file ({why}); export it again"
        ) from error
    _require_count(path, len(found))
    return found


def _ply(path: Path) -> GaussianSplats:
    import gsply

    _check_ply(path)
    return _from_library(gsply.plyread(path))


def _spz(path: Path) -> GaussianSplats:
    import gsply

    content = path.read_bytes()
    header = content[:_SPZ_HEADER]
    if not header.startswith(_SPZ_MAGIC):
        unpacking = zlib.decompressobj(31)
        header = unpacking.decompress(content, _SPZ_HEADER)
        _require_count(path, int.from_bytes(header[8:12], "little"))
        _refuse_longer(unpacking, int.from_bytes(header[8:12], "little") * _SPZ_MOST_BYTES + _HEADER_BYTES)
    _require_count(path, int.from_bytes(header[8:12], "little"))
    return _from_library(gsply.read_spz(path))


def _refuse_longer(unpacking: Any, most: int) -> None:
    """Refuse a stream that unpacks to more than its header speaks of: a few bytes can stand for gigabytes."""
    while not unpacking.eof and unpacking.unconsumed_tail:
        most -= len(unpacking.decompress(unpacking.unconsumed_tail, 1 << 20))
        if most < 0:
            raise ValueError("more data than Gaussians")


def _from_library(data: Any) -> GaussianSplats:
    """Gaussians of gsply, which leaves logarithms of sizes and logits of opacities as files have them."""
    count = len(data.means)
    rest = (
        np.asarray(data.shN, np.float32).reshape(count, -1, 3)
        if data.shN is not None
        else np.zeros((count, 0, 3), np.float32)
    )
    return _gaussians(
        data.means,
        np.exp(np.asarray(data.scales, np.float64)),
        data.quats,
        1.0 / (1.0 + np.exp(-np.asarray(data.opacities, np.float64).reshape(count))),
        np.concatenate([np.asarray(data.sh0, np.float32).reshape(count, 1, 3), rest], axis=1),
    )


def _splat(path: Path) -> GaussianSplats:
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        raise ValueError(f"{size} bytes are not whole records of {_RECORD.itemsize}")
    _require_count(path, size // _RECORD.itemsize)
    records = np.fromfile(path, _RECORD)
    colours = records["rgba"].astype(np.float32) / np.float32(255.0)
    rotations = (records["rotation"].astype(np.float32) - np.float32(128.0)) / np.float32(128.0)
    harmonics = (colours[:, None, :3] - np.float32(COLOUR_OFFSET)) / np.float32(CONSTANT_BASIS)
    return _gaussians(records["mean"], records["scale"], rotations, colours[:, 3], harmonics)


def _glb(path: Path) -> GaussianSplats:
    from advnerf_core.splats.gltf import read_gltf

    _require_count(path, max(1, path.stat().st_size // _RECORD.itemsize))
    return _gaussians(*read_gltf(path))


def _gaussians(means: Any, scales: Any, rotations: Any, opacities: Any, harmonics: Any) -> GaussianSplats:
    """Gaussians with unit quaternions; a quaternion without length becomes NaN."""
    parts: list[NDArray[np.float32]] = [
        np.ascontiguousarray(part, np.float32) for part in (means, scales, rotations, opacities, harmonics)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        lengths = np.linalg.norm(parts[2].astype(np.float64), axis=1, keepdims=True)
        parts[2] = np.where(lengths > 1e-12, parts[2] / lengths, np.nan).astype(np.float32)
    return GaussianSplats(*parts)


def _require_count(path: Path, count: int) -> None:
    if count == 0:
        raise SplatError(f"expected Gaussians in {path}, got none, as it has no points; export it again")
    if count > MOST_GAUSSIANS:
        raise SplatError(
            f"expected at most {MOST_GAUSSIANS:,} Gaussians in {path}, got {count:,}; prune it, or cut out the part that is driven through"
        )


def _check_ply(path: Path) -> None:
    """Check a PLY header against the file's size and against what gsply can read.

    Raises:
        ValueError: The header is damaged, or speaks of more data than there is.
        SplatError: The file holds no Gaussians.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    lines, end, _ = head.partition(b"end_header")
    words = [line.split() for line in lines.decode("ascii").splitlines()]
    if not words or words[0] != ["ply"] or not end:
        raise ValueError("no PLY header")
    elements: dict[str, int] = {}
    properties: dict[str, list[tuple[str, str]]] = {}
    name = ""
    for line in words:
        if line[:1] == ["element"]:
            name = line[1]
            elements[name], properties[name] = int(line[2]), []
        elif line[:1] == ["property"]:
            properties[name].append((line[1], line[-1]))
    names = {each for _, each in properties.get("vertex", [])}
    if "chunk" not in elements and not {"opacity", "scale_0", "rot_0", "f_dc_0"} <= names:
        if elements.get("face", 0) > 0:
            raise SplatError(f"expected Gaussians in {path}, got a mesh of triangles; {FOR_A_MESH}")
        raise SplatError(
            f"expected Gaussians in {path}, got points with {', '.join(sorted(names)) or 'nothing'}; give the splat that was trained from them"
        )
    if ["format", "binary_little_endian", "1.0"] not in words:
        raise ValueError("not in the format binary_little_endian 1.0")
    _require_count(path, elements.get("vertex", 0))
    _require_count(path, max(elements.values(), default=0))
    if min(elements.values(), default=0) < 0:
        raise ValueError("a negative number of elements")
    needed = sum(
        count * sum(_SIZES[kind] for kind, _ in properties[each]) for each, count in elements.items()
    )
    if len(lines) + len(end) + 1 + needed > path.stat().st_size:
        raise ValueError(f"{needed} bytes of data in the header, fewer in the file")
    if "chunk" in elements:
        if _CHUNK * elements["chunk"] < elements.get("vertex", 0):
            raise ValueError(f"{elements['chunk']} chunks for {elements.get('vertex', 0)} Gaussians")
    elif {kind for kind, _ in properties["vertex"]} - {"float", "float32"}:
        raise ValueError("properties that are not float")
