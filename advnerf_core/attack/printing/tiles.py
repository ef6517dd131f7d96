"""Division of a poster into pages of a paper size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from advnerf_core.attack.printing.poster import PrintError

Paper = Literal["a4", "a3", "a2", "a1", "a0", "letter", "tabloid", "none"]
# Width and height in portrait [mm]: ISO 216, and ANSI/ASME Y14.1 A and B.
PAPERS_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
# Below each tile: the ruler, and the tile's number.
FOOTER_MM = 10.0
_LEAST_MARGIN_MM, _LARGEST_MARGIN_MM, _LARGEST_OVERLAP_MM = 4.0, 40.0, 50.0
# Readers of PDF refuse larger pages (ISO 32000-1, annex C: 14,400 units).
_LARGEST_PAGE_MM = 5080.0
_MOST_PAGES = 1000


@dataclass(frozen=True)
class Tile:
    """One page's part of a poster.

    Attributes:
        row: Row from the top, from 0.
        column: Column from the left, from 0.
        left_mm: Left edge, from the poster's [mm].
        top_mm: Upper edge, from the poster's [mm].
    """

    row: int
    column: int
    left_mm: float
    top_mm: float


@dataclass(frozen=True)
class Layout:
    """Equal tiles on equal pages. Each tile repeats the first ``overlap_mm`` of the tiles right of it and below it, where these are glued on.

    Attributes:
        page_mm: Width and height of a page [mm].
        tile_mm: Width and height of a tile, with its overlap [mm].
        rows: Tiles above one another.
        columns: Tiles side by side.
        margin_mm: White margin on every side of a page; 0 for a page of the poster's own size.
        overlap_mm: Overlap of neighbours [mm].
    """

    page_mm: tuple[float, float]
    tile_mm: tuple[float, float]
    rows: int
    columns: int
    margin_mm: float
    overlap_mm: float

    @property
    def step_mm(self) -> tuple[float, float]:
        """Step from one tile to the next [mm]."""
        return self.tile_mm[0] - self.overlap_mm, self.tile_mm[1] - self.overlap_mm

    @property
    def tiles(self) -> list[Tile]:
        """All tiles, row by row."""
        across, down = self.step_mm
        return [Tile(r, c, c * across, r * down) for r in range(self.rows) for c in range(self.columns)]


def layout_of(size_mm: tuple[float, float], paper: Paper, margin_mm: float, overlap_mm: float) -> Layout:
    """The fewest pages that hold a poster, upright or on their side.

    Args:
        paper: Paper size; ``none`` is one page as large as the poster.
        margin_mm: White margin on every side [mm].
        overlap_mm: Overlap of neighbouring tiles [mm].

    Raises:
        PrintError: A margin or overlap that leaves no room, a page that PDF does not support, or more pages than anyone glues.
    """
    if paper == "none":
        if max(size_mm) > _LARGEST_PAGE_MM:
            raise PrintError(
                f"expected a page of at most {_LARGEST_PAGE_MM / 1000:g} m, got {max(size_mm) / 1000:g} m; choose a --paper"
            )
        return Layout(size_mm, size_mm, 1, 1, 0.0, 0.0)
    if not _LEAST_MARGIN_MM <= margin_mm <= _LARGEST_MARGIN_MM:
        raise PrintError(
            f"expected a margin of {_LEAST_MARGIN_MM:g} to {_LARGEST_MARGIN_MM:g} mm, for the crop marks, got {margin_mm:g} mm; "
            "correct --margin-mm"
        )
    if not 0.0 <= overlap_mm <= _LARGEST_OVERLAP_MM:
        raise PrintError(
            f"expected an overlap of 0 to {_LARGEST_OVERLAP_MM:g} mm, got {overlap_mm:g} mm; correct --overlap-mm"
        )
    width_mm, height_mm = PAPERS_MM[paper]
    pages = [(width_mm, height_mm), (height_mm, width_mm)]
    layouts = [_divided(size_mm, page_mm, margin_mm, overlap_mm) for page_mm in pages]
    found = min(layouts, key=lambda each: each.rows * each.columns)
    if (count := found.rows * found.columns) > _MOST_PAGES:
        raise PrintError(
            f"expected at most {_MOST_PAGES} pages, got {count} of {paper.title()} for {size_mm[0] / 1000:g} x {size_mm[1] / 1000:g} m; choose a larger "
            "--paper, or correct --object-size, which is in metres"
        )
    return found


def _divided(
    size_mm: tuple[float, float], page_mm: tuple[float, float], margin_mm: float, overlap_mm: float
) -> Layout:
    room_mm = (page_mm[0] - 2.0 * margin_mm, page_mm[1] - 2.0 * margin_mm - FOOTER_MM)
    columns, rows = (_count(size, room, overlap_mm) for size, room in zip(size_mm, room_mm, strict=True))
    # Equal tiles: no last column of a few millimetres.
    tile_mm = (
        (size_mm[0] + (columns - 1) * overlap_mm) / columns,
        (size_mm[1] + (rows - 1) * overlap_mm) / rows,
    )
    return Layout(page_mm, tile_mm, rows, columns, margin_mm, overlap_mm)


def _count(size_mm: float, room_mm: float, overlap_mm: float) -> int:
    return max(1, math.ceil((size_mm - overlap_mm) / (room_mm - overlap_mm) - 1e-9))
