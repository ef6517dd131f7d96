"""What core glTF 2.0 has and the reader of meshes leaves out without a word: refused from the header, with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from advnerf_core.objects.voxel.mesh import MeshError

_FLOAT, _TRIANGLE_FAN, _REPEAT = 5126, 6, 10497
_Entry = dict[str, Any]


def refuse_unread(header: _Entry, path: Path) -> None:
    """Refuse geometry and texture coordinates that would be read wrongly.

    Raises:
        MeshError: The mesh is skinned or morphed, has sparse accessors, triangle fans, or texture coordinates as whole numbers.
    """
    with _well_formed(path):
        found = "; ".join(dict.fromkeys(_unread(header)))
    if found:
        raise MeshError(f"expected plain triangles in {path}, got {found}; export it again")


def has_an_end(header: _Entry, path: Path) -> bool:
    """Whether some texture does not repeat beyond its edges.

    Raises:
        MeshError: A texture names a sampler that is not there.
    """
    samplers = header.get("samplers", [])
    with _well_formed(path):
        return any(
            samplers[texture["sampler"]].get(wrap, _REPEAT) != _REPEAT
            for texture in header.get("textures", [])
            if "sampler" in texture
            for wrap in ("wrapS", "wrapT")
        )


@contextmanager
def _well_formed(path: Path) -> Iterator[None]:
    """Say of a header whose entries are of another kind, or not there, that the file cannot be read."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise MeshError(f"cannot read {path} as a mesh (glTF: {error!r}); export it again") from error


def _unread(header: _Entry) -> Iterator[str]:
    """Sections 3.7.3.3 (skins), 3.7.2.2 (morph targets), 3.6.2.3 (sparse accessors) and 3.7.2.1 (primitives) of the specification."""
    nodes, meshes, accessors = (header.get(key, []) for key in ("nodes", "meshes", "accessors"))
    if any("skin" in node and "mesh" in node for node in nodes):
        yield "a skin, whose bones place the vertices (apply the armature)"
    if any(any(each.get("weights", ())) for each in (*nodes, *meshes)):
        yield "weights of morph targets (apply the shape keys)"
    if any("sparse" in accessor for accessor in accessors):
        yield "sparse accessors"
    primitives = [primitive for mesh in meshes for primitive in mesh.get("primitives", [])]
    if any(primitive.get("mode") == _TRIANGLE_FAN for primitive in primitives):
        yield "triangle fans (triangulate it)"
    for primitive in primitives:
        coordinates = primitive.get("attributes", {}).get("TEXCOORD_0")
        if coordinates is not None and accessors[coordinates].get("componentType") != _FLOAT:
            yield "texture coordinates as whole numbers (without quantisation or compression)"
