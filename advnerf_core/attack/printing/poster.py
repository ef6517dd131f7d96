"""The printable texture of an attack: the object that carries it, its size, and its pixels at any resolution."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import AttackedObject, AttackFile, face_texture
from advnerf_core.attack.printing.frame import CHART_SET, MarkerFrame, frame_around
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array
from advnerf_core.plugins import unknown

Rgb = NDArray[np.uint8]
MM_PER_INCH, MM_PER_M = 25.4, 1000.0
# Per picture; at three bytes a pixel, and as much again while it is compressed.
_MAX_PIXELS = 200_000_000
_STRIP_ROWS = 256


class PrintError(AdvnerfError, ValueError):
    """An attack, or a size, that cannot be printed."""


@dataclass(frozen=True, eq=False)
class Printable:
    """A picture at its true size, alone or with markers around it.

    Attributes:
        texture: The picture, ``[H, W, 3]`` uint8 sRGB; row 0 on top, column 0 left for the viewer.
        size_m: Width and height of the picture [m].
        frame: Markers around it; None for the picture alone.
    """

    texture: Rgb
    size_m: tuple[float, float]
    frame: MarkerFrame | None = None

    @property
    def sheet_mm(self) -> tuple[float, float]:
        """Width and height of all that is printed [mm]."""
        width, height = self.size_m if self.frame is None else self.frame.sheet_m
        return width * MM_PER_M, height * MM_PER_M

    def pixels(self, box_mm: tuple[float, float, float, float], size_px: tuple[int, int]) -> Rgb:
        """A part of the sheet; the texture is interpolated bilinearly between its pixel centres.

        Args:
            box_mm: Left, top, width and height of the part, from the sheet's upper left corner [mm].
            size_px: Width and height of the part [px].

        Returns:
            The part ``[height, width, 3]``.
        """
        left, top, width, height = box_mm
        across_m = (left + width * _centres(size_px[0])) / MM_PER_M
        down_m = (top + height * _centres(size_px[1])) / MM_PER_M
        border_m = 0.0 if self.frame is None else self.frame.border_m
        columns, rows = (across_m - border_m) / self.size_m[0], (down_m - border_m) / self.size_m[1]
        if self.frame is None:
            return _bilinear(self.texture, rows, columns)
        found = self.frame.drawn(across_m, down_m)
        inside = tuple(np.flatnonzero((share >= 0.0) & (share < 1.0)) for share in (rows, columns))
        if all(map(len, inside)):
            found[np.ix_(*inside)] = _bilinear(self.texture, rows[inside[0]], columns[inside[1]])
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class Poster(Printable):
    """The flat texture of an attack.

    Attributes:
        attack: The attack of this texture.
        name: The object that carries it.
        T_world_from_face: Frame ``[4, 4]`` at its centre: x out of it towards a viewer, z up.
        marker_m: Side of the markers in the border that it had in the search [m]; None without a border.
    """

    attack: AttackFile
    name: str
    T_world_from_face: Array
    marker_m: float | None

    def with_markers(self, marker_m: float | None = None) -> Poster:
        """The same poster with markers around it, whose numbers come from the attack's id.

        Args:
            marker_m: Side of a marker [m]; None for that of the search, or a share of the picture.

        Raises:
            PrintError: The markers are larger than the picture: they would touch or cover each other.
        """
        number = int(self.attack.attack_id, 16) % CHART_SET
        frame = frame_around(self.size_m, number, marker_m or self.marker_m)
        if frame.marker_m > min(self.size_m):
            raise PrintError(
                f"expected markers of at most {min(self.size_m) * MM_PER_M:g} mm, the texture's shorter side, as larger ones would touch, got "
                f"{frame.marker_m * MM_PER_M:g} mm; correct --marker-mm, or add --no-markers"
            )
        return replace(self, frame=frame)


def poster_of(attack: AttackFile, name: str | None = None, edge_m: float | None = None) -> Poster:
    """The printable texture of an attack.

    Args:
        name: The object, by name or number; None if only one can be printed.
        edge_m: Edge of a square panel [m], for attack files without a size.

    Raises:
        PrintError: The attack has no flat texture, or several, or the size is unknown.
    """
    flat = {number: each for number, each in enumerate(attack.objects) if _is_flat(attack, number)}
    number = _chosen(attack, flat, name)
    chosen, face = attack.objects[number], attack.face
    texture, held_m = (
        (face.texture, face.size_m)
        if face is not None and face.carried_by == number
        else (face_texture(chosen.theta), chosen.size_m)
    )
    size_m = _size(chosen, held_m, edge_m)
    return Poster(
        texture,
        size_m,
        attack=attack,
        name=chosen.name,
        T_world_from_face=np.asarray(chosen.T_world_from_object),
        marker_m=chosen.marker_m,
    )


def pixels_of(size_mm: tuple[float, float], dpi: float) -> tuple[int, int]:
    """Width and height [px] of a picture of this size.

    Raises:
        PrintError: More pixels than fit into memory.
    """
    width, height = (max(1, round(each / MM_PER_INCH * dpi)) for each in size_mm)
    if width * height > _MAX_PIXELS:
        fits = int(dpi * (_MAX_PIXELS / (width * height)) ** 0.5)
        raise PrintError(
            f"expected at most {_MAX_PIXELS // 10**6} million pixels in a picture, got {width} x {height}; use --dpi {fits}"
        )
    return width, height


def png_bytes(sheet: Printable, dpi: float) -> bytes:
    """The whole sheet as a PNG with its physical size.

    Source: PNG specification, second edition, 11.3.5.3: ``pHYs`` holds whole pixels per metre, anywhere before the image data.
    """
    per_m = round(dpi * MM_PER_M / MM_PER_INCH)
    size_px = pixels_of(sheet.sheet_mm, per_m * MM_PER_INCH / MM_PER_M)
    picture = sheet.pixels((0.0, 0.0, *sheet.sheet_mm), size_px)
    data = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    chunk = b"pHYs" + struct.pack(">IIB", per_m, per_m, 1)
    after_header = 33  # signature, and the chunk IHDR
    inserted = struct.pack(">I", 9) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return data[:after_header] + inserted + data[after_header:]


def _is_flat(attack: AttackFile, number: int) -> bool:
    """Whether an object has a flat texture: it carries the face, or its colours are a grid and no mesh."""
    each, face = attack.objects[number], attack.face
    return (face is not None and face.carried_by == number) or (each.theta.ndim == 3 and not each.glb)


def _chosen(attack: AttackFile, flat: dict[int, AttackedObject], name: str | None) -> int:
    if name is None:
        found = list(flat)
    else:
        names = [each.name for each in attack.objects]
        named = [number for number, each in enumerate(names) if name in (each, str(number))]
        if not named:
            raise PrintError(f"--object: {unknown(name, 'object', names)}")
        found = [number for number in named if number in flat]
    if not found:
        raise PrintError(_nothing_flat(attack, flat))
    if len(found) > 1:
        rows = ", ".join(f"{number} ({flat[number].name})" for number in found)
        raise PrintError(
            f"expected one texture to print, got several; choose one with --object and its number: {rows}"
        )
    return found[0]


def _nothing_flat(attack: AttackFile, flat: dict[int, AttackedObject]) -> str:
    solid = [each for number, each in enumerate(attack.objects) if number not in flat]
    can = f"print one of {', '.join(each.name for each in flat.values())}" if flat else "attack one of these"
    meshes = "; 'advnerf attack show' writes its meshes as GLB" if any(each.glb for each in solid) else ""
    return (
        f"expected the texture of a face or panel, got the solid object {', '.join(each.name for each in solid)}, "
        f"which has no flat texture; {can}{meshes}"
    )


def _size(
    chosen: AttackedObject, held_m: tuple[float, float] | None, edge_m: float | None
) -> tuple[float, float]:
    if held_m is not None and edge_m is not None:
        raise PrintError(
            f"expected no --object-size for {chosen.name}, whose attack file says {held_m[0]:g} x {held_m[1]:g} m; leave it out"
        )
    if held_m is None and edge_m is None:
        raise PrintError(
            f"expected the size of {chosen.name} in the attack file, got an older file without it; "
            "give the edge with --object-size (of an experiment's panel: 2 m times its scale)"
        )
    return held_m or (edge_m or 0.0, edge_m or 0.0)


def _centres(count: int) -> Array:
    """Pixel centres as shares of the whole, ``[count]``."""
    return (np.arange(count) + 0.5) / count


def _bilinear(texture: Rgb, rows: Array, columns: Array) -> Rgb:
    """The texture at shares of its height ``[h]`` and width ``[w]``, clamped at the border: ``[h, w, 3]``."""
    (top, bottom, down), (left, right, along) = (
        _neighbours(at, size) for at, size in zip((rows, columns), texture.shape[:2], strict=True)
    )
    source = texture.astype(np.float32)
    wide = source[:, left] * (1.0 - along)[:, None] + source[:, right] * along[:, None]
    found = np.empty((len(rows), len(columns), 3), np.uint8)
    for begin in range(0, len(rows), _STRIP_ROWS):  # so that only the result is as large as the poster
        strip = slice(begin, begin + _STRIP_ROWS)
        share = down[strip, None, None]
        found[strip] = np.rint(wide[top[strip]] * (1.0 - share) + wide[bottom[strip]] * share)
    return found


def _neighbours(at: Array, size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """The two pixels about each position, and the weight of the second."""
    position = np.clip(at * size - 0.5, 0.0, size - 1.0)
    first = np.minimum(position.astype(np.intp), max(size - 2, 0))
    return first, np.minimum(first + 1, size - 1), (position - first).astype(np.float32)
