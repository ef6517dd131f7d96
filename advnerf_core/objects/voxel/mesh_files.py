"""Mesh files: read by trimesh, with each format's up axis, unit and colour space, and with all files that they name.

glTF fixes metres, y up and linear colour factors; OBJ, PLY and STL fix none of these.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from advnerf_core.documents import parse_json
from advnerf_core.errors import ConfigError
from advnerf_core.geometry import Array
from advnerf_core.inputs import InputFileError, InputFiles
from advnerf_core.objects.voxel.gltf_checks import has_an_end, refuse_unread
from advnerf_core.objects.voxel.mesh import MeshError, MeshPart, SurfaceMesh, part_from_colours, stand
from advnerf_core.srgb import to_display, to_linear

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
_GLTF = (".glb", ".gltf")
_GREY = (0.6, 0.6, 0.6)
# An object of a scene is larger than a nail and smaller than a stadium; other sizes come from another unit.
_SANE_SIDE_M = (0.01, 100.0)
# Extensions that change neither shape nor base colour, or that trimesh reads.
_KNOWN_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp", "KHR_xmp")
_TRANSPARENT = 250


def load_mesh(
    path: Path, up: str | None = None, height_m: float | None = None, unit: str | None = None
) -> SurfaceMesh:
    """Read a mesh file (GLB, OBJ, PLY, STL, ... all formats of trimesh).

    Args:
        path: The file; its textures and the scene graph's transforms are applied.
        up: Up axis of the file, ``"z"`` or ``"y"``; None: y for glTF, z for the others.
        height_m: Scale to this height [m], regardless of the unit.
        unit: The file's unit of length: ``mm``, ``cm``, ``m`` or ``in``; None: the metre for glTF.

    Raises:
        MeshError: The file is missing, not a mesh or without triangles; an image that it names is missing or broken; coordinates are not
            finite; the unit is unknown; or the size is impossible for an object.
    """
    if unit is not None and unit not in UNITS_M:
        raise MeshError(f"expected a unit of {', '.join(UNITS_M)}, got {unit!r}")
    if height_m is not None and not (np.isfinite(height_m) and height_m > 0):
        raise MeshError(f"expected a height above zero, got {height_m}")
    files, named = read_mesh_files(path)
    _refuse_broken_images(files)
    notes: list[str] = []
    parts = [_part(geometry, path, notes) for geometry in _geometries(files, named)]
    if not parts or sum(len(part.triangles) for part in parts) == 0:
        raise MeshError(
            f"expected a mesh with triangles in {path}, got none: is it a point cloud or an empty scene?"
        )
    gltf = path.suffix.lower() in _GLTF
    if gltf and has_an_end(_gltf_header(path, files.content), path):
        _require_inside(parts, path)
    mesh = stand(SurfaceMesh(tuple(parts)), up or ("y" if gltf else "z"), height_m, str(path))
    if height_m is None:
        mesh = mesh.scaled(_metres(path, mesh, unit, gltf))
    side = float(mesh.size_m.max())
    if not _SANE_SIDE_M[0] <= side <= _SANE_SIDE_M[1]:
        given = f"the unit {unit}" if height_m is None else f"a height of {height_m:g} m"
        raise MeshError(
            f"expected {path} to have a longest side of {_SANE_SIDE_M[0]:g} to {_SANE_SIDE_M[1]:g} m, got {side:.4g} m by {given}; correct it"
        )
    return SurfaceMesh(mesh.parts, tuple(dict.fromkeys(notes)), files.sha256())


def read_mesh_files(path: Path) -> tuple[InputFiles, dict[str, bytes]]:
    """A mesh file with all files that it names: materials, buffers and images. Each is read once; links and other folders are rejected.

    Returns:
        The files, and the content of the named ones, under the names in the mesh file.

    Raises:
        MeshError: Some of them cannot be read; the message names all of these.
    """
    if not path.is_file():
        raise MeshError(f"expected a mesh file at {path}, found none")
    files = InputFiles(path)
    contents: dict[str, bytes] = {}
    problems: list[str] = []

    def read(written: str, name: str) -> bytes:
        try:
            contents[written] = files.read(name)
        except InputFileError as error:
            problems.append(str(error))
        return contents.get(written, b"")

    kind = path.suffix.lower()
    if kind == ".obj":
        _read_named_by_obj(files.content, read)
    elif kind == ".ply":
        _read_named_by_ply(files.content, read)
    elif kind in _GLTF:
        _read_named_by_gltf(path, files.content, read)
    if problems:
        raise MeshError(f"{'; '.join(problems)}; or export the mesh as one GLB")
    return files, contents


def _metres(path: Path, mesh: SurfaceMesh, unit: str | None, gltf: bool) -> float:
    """Factor from the file's unit to metres."""
    side = float(mesh.size_m.max())
    if unit is not None:
        return UNITS_M[unit]
    if gltf and _SANE_SIDE_M[0] <= side <= _SANE_SIDE_M[1]:
        return 1.0
    choices = ", ".join(f"{name} (longest side {side * factor:.4g} m)" for name, factor in UNITS_M.items())
    if gltf:
        raise MeshError(
            f"expected {path} in metres, as glTF defines, got a longest side of {side:.4g} m; give its unit: {choices}; or its height"
        )
    raise MeshError(
        f"expected the unit of {path}, which {path.suffix or 'its format'} does not say; give it: {choices}; or give its height"
    )


_EDGE = 1e-3  # beyond the image, in its sides
_MTL = re.compile(r".+\.mtl", re.IGNORECASE)
_PLY_COLOUR = re.compile(r"^property\s+(\w+)\s+((?:diffuse_)?(?:red|green|blue))\s*$", re.MULTILINE)
_PLY_KINDS = ("uchar", "uint8", "float", "float32", "double", "float64")
_Read = Callable[[str, str], bytes]


def _read_named_by_obj(content: bytes, read: _Read) -> None:
    libraries = [words[1:] for words in _lines(content) if words[0] == "mtllib" and len(words) > 1]
    names = [words if all(map(_MTL.fullmatch, words)) else [" ".join(words)] for words in libraries]
    if len(several := dict.fromkeys(name for each in names for name in each)) > 1:
        raise MeshError(
            f"expected one library of materials (mtllib), got {', '.join(several)}; join them into one file, or export the mesh as one GLB"
        )
    for words in libraries[:1]:
        library = _name(words)
        for line in _lines(read(library, library)):
            if line[0].lower() in ("map_kd", "map_ka") and len(line) > 1:
                image = _name(line[1:])
                read(image, (PurePosixPath(library.replace("\\", "/")).parent / image).as_posix())


def _read_named_by_ply(content: bytes, read: _Read) -> None:
    header = content.partition(b"end_header")[0].decode(errors="replace")
    for kind, name in _PLY_COLOUR.findall(header):
        if kind not in _PLY_KINDS or name.startswith("diffuse_"):
            raise MeshError(
                f"expected colours of vertices as uchar or float properties red, green and blue, got {kind} {name}; export it again with those"
            )
    for image in re.findall(r"^comment\s+TextureFile\s+(.+?)\s*$", header, re.I | re.M):
        read(image, image)


def _name(words: list[str]) -> str:
    """A named file. Options before it, which move or scale the image, are not read."""
    if words[0].startswith("-"):
        raise MeshError(
            f"expected the name of an image alone in the materials, got {' '.join(words)}; remove the options if they change nothing, or export the "
            "mesh as one GLB"
        )
    return " ".join(words)


def _lines(content: bytes) -> Iterator[list[str]]:
    for line in content.decode(errors="replace").splitlines():
        if line.lstrip().lower().startswith(("mtllib", "map_")):
            yield line.split()


def _read_named_by_gltf(path: Path, content: bytes, read: _Read) -> None:
    header = _gltf_header(path, content)
    required = [
        each for each in header.get("extensionsRequired", []) if not each.startswith(_KNOWN_EXTENSIONS)
    ]
    used = [each for each in header.get("extensionsUsed", []) if each == "KHR_texture_transform"]
    if required or used:
        raise MeshError(
            f"expected a mesh without the glTF extension {', '.join({*required, *used})}, got {path}; export it again without it"
        )
    refuse_unread(header, path)
    for material in header.get("materials", []):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        if texture.get("texCoord", 0) != 0:
            raise MeshError(
                f"expected colours by the first texture coordinates (texCoord 0) in {path}, got texCoord {texture['texCoord']}; make these the first "
                "UV map, and export it again"
            )
    entries = [*header.get("images", []), *header.get("buffers", [])]
    for name in (str(entry["uri"]) for entry in entries if "uri" in entry):
        if not name.startswith("data:"):
            read(name, unquote(name))


def _refuse_broken_images(files: InputFiles) -> None:
    """Reject images that cannot be decoded: trimesh would leave them out, and show white."""
    path = files.path
    contents = [
        (str(path.parent / name), content)
        for name, content in files.others.items()
        if PurePosixPath(name).suffix.lower() not in (".mtl", ".bin")
    ]
    if path.suffix.lower() == ".glb":
        embedded = enumerate(_embedded(path, files.content))
        contents += [(f"image {k} of {path}", content) for k, content in embedded]
    for name, content in contents:
        try:
            with Image.open(io.BytesIO(content)) as image:
                image.load()
        except (OSError, SyntaxError, ValueError) as error:
            raise MeshError(
                f"expected a readable texture, got {name} ({len(content)} bytes): {error}"
            ) from error


def _embedded(path: Path, data: bytes) -> Iterator[bytes]:
    """The images inside a GLB file."""
    header = _gltf_header(path, data)
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8
    for image in header.get("images", []):
        if "bufferView" in image:
            view = header["bufferViews"][image["bufferView"]]
            at = start + view.get("byteOffset", 0)
            yield data[at : at + view["byteLength"]]


def _gltf_header(path: Path, data: bytes) -> dict[str, Any]:
    try:
        if data.startswith(b"glTF"):
            (length,) = struct.unpack_from("<I", data, 12)
            data = data[20 : 20 + length]
        header = parse_json(data, str(path))
    except (ConfigError, struct.error) as error:
        raise MeshError(f"cannot read {path} as a mesh (glTF: {error}); export it again") from error
    if not isinstance(header, dict):
        raise MeshError(f"cannot read {path} as a mesh (glTF: no object in JSON); export it again")
    return header


def _geometries(files: InputFiles, named: dict[str, bytes]) -> list[Any]:
    """Geometries of the files; trimesh opens no file itself."""
    import trimesh

    path = files.path
    try:
        kind = path.suffix.lower().removeprefix(".")
        scene = trimesh.load_scene(io.BytesIO(files.content), file_type=kind, resolver=named)
        for geometry in scene.geometry.values():
            # Beside a material they belong to the visual, whose copies lose them.
            if (colours := getattr(geometry.visual, "vertex_attributes", {}).get("color")) is not None:
                geometry.vertex_attributes["color"] = colours
        dumped = scene.dump(concatenate=False)
    except Exception as error:  # trimesh's readers raise any exception
        raise MeshError(
            f"cannot read {path} as a mesh ({type(error).__name__}: {error}); export it again"
        ) from error
    return [geometry for geometry in dumped if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)]


def _part(geometry: Any, path: Path, notes: list[str]) -> MeshPart:
    faces = np.asarray(geometry.faces)
    triangles = np.asarray(geometry.vertices, dtype=np.float64)[faces]
    visual, linear = geometry.visual, path.suffix.lower() in _GLTF
    uv, material = getattr(visual, "uv", None), getattr(visual, "material", None)
    notes += _see_through(material, path, linear)
    if material is not None and (shades := geometry.vertex_attributes.get("color")) is not None:
        rgb = _shares(np.asarray(shades)[:, :3])
        if not _names_an_image(material):
            rgb = rgb[faces].mean(axis=1) * (_factor(material) if linear else 1.0)
            return part_from_colours(triangles, _displayed(rgb, linear))
        if rgb.min() < 1.0:
            notes.append(
                f"{path.name} has colours of vertices over a texture; they are left out, so bake them into it"
            )
    if uv is not None and len(uv) == len(geometry.vertices):
        texture = _texture(visual.material, path, linear, notes)
        return MeshPart(triangles, np.nan_to_num(np.asarray(uv, dtype=np.float64))[faces], texture)
    colours = getattr(visual, "face_colors", None)
    if visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[faces].mean(axis=1)
    if visual.defined and colours is not None and len(colours) == len(faces):
        return part_from_colours(triangles, _displayed(np.asarray(colours)[:, :3] / 255.0, linear))
    if _names_an_image(material):
        raise MeshError(
            f"expected texture coordinates for the image of {path}, got none; export it again with them"
        )
    return part_from_colours(triangles, np.broadcast_to(_plain_colour(material, linear), (len(faces), 3)))


def _require_inside(parts: Sequence[MeshPart], path: Path) -> None:
    """Raise for texture coordinates beyond the edges of an image that does not repeat there: all images are sampled as repeating."""
    outside = [each.uv for each in parts if each.texture.shape[:2] != (1, 1)]
    if any(uv.size and (uv.min() < -_EDGE or uv.max() > 1.0 + _EDGE) for uv in outside):
        raise MeshError(
            f"expected texture coordinates within 0..1 in {path}, whose images are clamped or mirrored beyond their edges, got some outside; let them "
            "repeat, or unwrap the mesh within the image"
        )


def _names_an_image(material: Any) -> bool:
    return any(getattr(material, name, None) is not None for name in ("baseColorTexture", "image"))


def _plain_colour(material: Any, linear: bool) -> Array:
    """A material's colour without an image, in display values; grey without a material."""
    if material is not None and linear:
        return _displayed(_factor(material), True)
    main = getattr(material, "main_color", None)
    return np.array(_GREY) if main is None else np.asarray(main, np.float64)[:3] / 255.0


def _factor(material: Any) -> Array:
    """The factor ``[3]`` of a glTF material on its colours, in linear light."""
    factor = getattr(material, "baseColorFactor", None)
    return np.ones(3) if factor is None else np.asarray(factor, np.float64)[:3] / 255.0


def _see_through(material: Any, path: Path, linear: bool) -> list[str]:
    """A note about a glTF material whose factor makes it transparent; its textures have notes of their own."""
    factor = getattr(material, "baseColorFactor", None)
    opaque = not linear or getattr(material, "alphaMode", None) in (None, "OPAQUE")
    if opaque or factor is None or len(factor) < 4 or factor[3] >= _TRANSPARENT:
        return []
    return [
        f"a material of {path.name} is opaque to {factor[3] / 255:.0%} only; objects are opaque, so it is shown opaque"
    ]


def _shares(colours: NDArray[Any]) -> Array:
    """Colours in 0..1, from whole numbers of any length, or from 0..1 or 0..255."""
    whole = np.issubdtype(colours.dtype, np.integer)
    largest = np.iinfo(colours.dtype).max if whole else 255.0 if colours.max(initial=0.0) > 1.0 else 1.0
    return np.asarray(colours, np.float64) / largest


def _texture(material: Any, path: Path, linear: bool, notes: list[str]) -> NDArray[np.float32]:
    image = getattr(material, "baseColorTexture", None)
    if image is None:
        image = getattr(material, "image", None)
    if image is None:
        return _plain_colour(material, linear).astype(np.float32).reshape(1, 1, 3)
    try:
        if image.mode.startswith("I"):  # 16 bits of grey, which PIL would cut off at 255
            image = Image.fromarray((np.asarray(image, np.float32) / 257.0).round().astype(np.uint8))
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32) / np.float32(255.0)
    except OSError as error:
        raise MeshError(f"cannot read a texture of {path} ({error}); export it again") from error
    opaque = linear and getattr(material, "alphaMode", None) in (None, "OPAQUE")
    if not opaque and 255.0 * rgba[..., 3].min() < _TRANSPARENT:
        share = float((255.0 * rgba[..., 3] < _TRANSPARENT).mean())
        notes.append(
            f"a texture of {path.name} is transparent in {share:.0%} of its texels; objects are opaque, so it is shown opaque there"
        )
    factor = getattr(material, "baseColorFactor", None)
    rgb = np.ascontiguousarray(rgba[..., :3])
    if factor is None or (np.asarray(factor)[:3] == 255).all():
        return rgb
    product = to_linear(rgb) * np.asarray(factor, np.float64)[:3] / 255.0 if linear else rgb
    return np.ascontiguousarray(_displayed(product, linear), dtype=np.float32)


def _displayed(rgb: Array, linear: bool) -> Array:
    """Display values of colours 0..1, by the sRGB curve where they are linear light."""
    return np.asarray(to_display(rgb) if linear else rgb, np.float64)
