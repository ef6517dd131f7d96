"""A white border with square markers around a printed picture, by which a photograph of the print can be measured.

The markers are AprilTags: eleven bits separate any two of them, so that a wrong detection is rare. Their numbers say which print it is among
others in the same room, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.aruco import marker_dictionary
from advnerf_core.geometry import Array

DICTIONARY = "DICT_APRILTAG_36h11"
CELLS = 8  # along a marker's side, its black edge included
SET_SIZE, SETS = 16, 36  # numbers of one print, and how many prints have numbers of their own
CHART_SET = SETS - 1
_QUIET_CELLS = 1.5  # white around a marker
_SHARE, _LEAST_M, _LARGEST_M = 0.12, 0.02, 0.15  # of the picture's shorter side
_SPACING = 4.0  # of markers along an edge, in their sides
_MOST_BETWEEN = 3

Rgb = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class MarkerFrame:
    """Markers around a picture, in the picture's frame: y to a viewer's right, z up, from its centre.

    Attributes:
        picture_m: Width and height of the picture [m].
        marker_m: Side of a marker [m].
        first: Number of the first marker; the others follow.
    """

    picture_m: tuple[float, float]
    marker_m: float
    first: int

    @property
    def border_m(self) -> float:
        """Width of the border on every side [m]."""
        return self.marker_m * (1.0 + 2.0 * _QUIET_CELLS / CELLS)

    @property
    def sheet_m(self) -> tuple[float, float]:
        """Width and height of the picture with its border [m]."""
        return self.picture_m[0] + 2.0 * self.border_m, self.picture_m[1] + 2.0 * self.border_m

    @cached_property
    def corners_m(self) -> dict[int, Array]:
        """Corners ``[4, 3]`` by number: top left, top right, bottom right, bottom left for a viewer; x, out of the picture, is 0 [m]."""
        half = 0.5 * self.marker_m * np.array([[0, -1, 1], [0, 1, 1], [0, 1, -1], [0, -1, -1]], np.float64)
        return {self.first + k: half + np.array([0.0, y, z]) for k, (y, z) in enumerate(self._centres())}

    def _centres(self) -> list[tuple[float, float]]:
        right, top = (0.5 * (edge + self.border_m) for edge in self.picture_m)
        across, down = (self._between(edge) for edge in self.picture_m)
        rows = [(y, z) for z in (top, -top) for y in np.linspace(-right, right, across + 2)]
        return rows + [(y, z) for y in (-right, right) for z in np.linspace(top, -top, down + 2)[1:-1]]

    def _between(self, edge_m: float) -> int:
        """Number of markers between those in two corners."""
        return int(np.clip(round(edge_m / (_SPACING * self.marker_m)), 1, _MOST_BETWEEN))

    def drawn(self, across_m: Array, down_m: Array) -> Rgb:
        """The border without the picture ``[h, w, 3]``, at distances from the sheet's left ``[w]`` and upper ``[h]`` edge [m]."""
        found = np.full((len(down_m), len(across_m), 3), 255, np.uint8)
        y, z = across_m - 0.5 * self.sheet_m[0], 0.5 * self.sheet_m[1] - down_m
        for number, corners in self.corners_m.items():
            column = np.floor((y - corners[0, 1]) / self.marker_m * CELLS).astype(int)
            row = np.floor((corners[0, 2] - z) / self.marker_m * CELLS).astype(int)
            columns, rows = ((each >= 0) & (each < CELLS) for each in (column, row))
            cells = marker_cells(number)[np.ix_(row[rows], column[columns])]
            found[np.ix_(rows, columns)] = cells[..., None]
        return found


def frame_around(picture_m: tuple[float, float], number: int, marker_m: float | None = None) -> MarkerFrame:
    """The markers around a picture.

    Args:
        picture_m: Width and height of the picture [m].
        number: Chooses the markers' numbers; prints of other numbers differ from this one, up to `SETS`.
        marker_m: Side of a marker [m]; None for a share of the picture.
    """
    side_m = float(np.clip(_SHARE * min(picture_m), _LEAST_M, _LARGEST_M)) if marker_m is None else marker_m
    return MarkerFrame(picture_m, side_m, SET_SIZE * (number % SETS))


def whole_cells(picture_m: float, cells: int, marker_m: float) -> tuple[float, int]:
    """The size of markers next to a wanted one whose border is a whole number of a texture's cells wide.

    Args:
        picture_m: Edge of the picture [m].
        cells: Colours along it.
        marker_m: Wanted side of a marker [m].

    Returns:
        Side of a marker [m], and the cells across the border.
    """
    cell_m, sides = picture_m / cells, 1.0 + 2.0 * _QUIET_CELLS / CELLS
    across = max(1, round(marker_m * sides / cell_m))
    return across * cell_m / sides, across


def marker_cells(number: int) -> NDArray[np.uint8]:
    """Cells of a marker ``[8, 8]``, 0 or 255, its black edge included."""
    return np.asarray(cv2.aruco.generateImageMarker(marker_dictionary(DICTIONARY), number, CELLS), np.uint8)
