"""The JSON file beside a print: true sizes and markers, by which a photograph of it is measured."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from advnerf_core.attack.printing.frame import DICTIONARY, SET_SIZE, SETS, MarkerFrame
from advnerf_core.attack.printing.poster import Poster, PrintError
from advnerf_core.documents import read_json
from advnerf_core.errors import ConfigError
from advnerf_core.files import write_json
from advnerf_core.plain import Numbers, PlainData

SUFFIX = ".print.json"
_LEAST_M, _LARGEST_M, _SAME_M = 0.01, 50.0, 1e-6
Kind = Literal["poster", "chart"]
_WRITTEN_BY = {"poster": "advnerf attack print", "chart": "advnerf car calibrate printer-chart"}


@dataclass(frozen=True, eq=False)
class PrintRecord(PlainData):
    """What was printed. Its frame: x out of the picture's centre towards a viewer, y to the viewer's right, z up.

    Attributes:
        kind: An attack's poster, or a chart of colours.
        picture_m: Width and height of the picture, without its border [m].
        sheet_m: Width and height with the border [m].
        dictionary: OpenCV's name of the markers.
        markers: Corners ``[4, 3]`` by number [m]; see `MarkerFrame.corners_m`.
        attack_id: The attack of a poster.
        attack_file: Path of the attack, relative to the record's folder.
        object: The object that carries the texture.
        patches: sRGB colours ``[rows, columns, 3]`` (0..255) of a chart, which fill its picture from the upper left.
    """

    _refusal = PrintError
    kind: Kind
    picture_m: tuple[float, float]
    sheet_m: tuple[float, float]
    dictionary: str
    markers: Mapping[int, Numbers]
    dpi: float
    attack_id: str = ""
    attack_file: str = ""
    object: str = ""
    patches: Numbers | None = None

    @property
    def frame(self) -> MarkerFrame:
        """The markers around the picture."""
        first = min(self.markers)
        return MarkerFrame(self.picture_m, float(np.ptp(self.markers[first][:, 1])), first)

    def require(self, kind: Kind) -> None:
        """Refuse the record of the other kind of print.

        Raises:
            PrintError: It is of the other kind.
        """
        if self.kind != kind:
            raise PrintError(
                f"expected the record of a {kind}, got that of a {self.kind}; give the {SUFFIX} that "
                f"'{_WRITTEN_BY[kind]}' wrote beside the {kind}"
            )

    def __post_init__(self) -> None:
        sizes = np.array([*self.picture_m, *self.sheet_m])
        if not (np.isfinite(sizes).all() and (sizes > _LEAST_M).all() and (sizes < _LARGEST_M).all()):
            raise PrintError(
                f"expected sizes of {_LEAST_M:g} to {_LARGEST_M:g} m, got {self.picture_m} and {self.sheet_m}"
            )
        if self.dictionary != DICTIONARY:
            raise PrintError(f"expected markers of {DICTIONARY}, got {self.dictionary!r}")
        for number, corners in self.markers.items():
            if not 0 <= number < SET_SIZE * SETS or corners.shape != (4, 3) or not np.isfinite(corners).all():
                raise PrintError(
                    f"expected corners [4, 3] of marker {number}, finite, got {corners.tolist()}"
                )
        if len(self.markers) < 3:
            raise PrintError(f"expected at least 3 markers, got {len(self.markers)}; print it with markers")
        frame = self.frame
        same = set(frame.corners_m) == set(self.markers) and all(
            np.allclose(corners, self.markers[number], atol=_SAME_M)
            for number, corners in frame.corners_m.items()
        )
        if not same or not np.allclose(frame.sheet_m, self.sheet_m, atol=_SAME_M):
            raise PrintError(
                "expected markers where the size of picture and sheet puts them, got others: the file was changed"
            )
        if (self.kind == "chart") != (self.patches is not None):
            raise PrintError("expected patches of a chart, and none of a poster")
        if self.patches is not None and (self.patches.ndim != 3 or self.patches.shape[2] != 3):
            raise PrintError(f"expected patches [rows, columns, 3], got {self.patches.shape}")


def record_of(frame: MarkerFrame, dpi: float, **others: Any) -> PrintRecord:
    """The record of a sheet with markers; ``others`` are the fields that depend on what is printed."""
    return PrintRecord(
        picture_m=frame.picture_m,
        sheet_m=frame.sheet_m,
        dictionary=DICTIONARY,
        markers=frame.corners_m,
        dpi=dpi,
        **others,
    )


def poster_record(poster: Poster, attack_file: Path, folder: Path, dpi: float) -> PrintRecord:
    """The record of a poster with markers."""
    assert poster.frame is not None, "a poster without markers cannot be measured"
    seen_from = Path(os.path.relpath(attack_file.resolve(), folder.resolve())).as_posix()
    about = {"attack_id": poster.attack.attack_id, "attack_file": seen_from, "object": poster.name}
    return record_of(poster.frame, dpi, kind="poster", **about)


def require_free(path: Path, record: PrintRecord) -> None:
    """Refuse to replace the record of another print, which could not be measured without it; resolution is no difference.

    Raises:
        PrintError: The path holds another record, or something else.
    """
    if path.exists() and replace(load_record(path), dpi=record.dpi).to_dict() != record.to_dict():
        raise PrintError(
            f"expected no record of another print at {path}, which is measured by it; choose another --output, or remove that file"
        )


def save_record(record: PrintRecord, path: Path) -> None:
    """Write a record."""
    write_json(path, record.to_dict())


def load_record(path: Path, kind: Kind | None = None) -> PrintRecord:
    """Read a record, of one kind of print if it is given.

    Raises:
        PrintError: The file is missing, damaged, something else, or of the other kind.
    """
    try:
        found = read_json(path)
        if not isinstance(found, dict):
            raise PrintError(f"expected the record of a print, got a {type(found).__name__}")
        record = PrintRecord.from_dict(found)
    except (ConfigError, PrintError) as error:
        raise PrintError(f"{path}: {error}; give the {SUFFIX} that was written beside the print") from error
    try:
        record.require(kind or record.kind)
    except PrintError as error:
        raise PrintError(f"{path}: {error}") from error
    return record
