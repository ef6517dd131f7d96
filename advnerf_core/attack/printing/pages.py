"""The pages of a printed attack: its tiles, and the sheet that explains how to print, check and hang them."""

from __future__ import annotations

from advnerf_core.attack.printing.pdf import Page, PdfDocument
from advnerf_core.attack.printing.poster import Poster, pixels_of
from advnerf_core.attack.printing.sheet import RULER_MM, overview, ruler
from advnerf_core.attack.printing.tiles import FOOTER_MM, Layout, Paper, Tile

# Crop marks begin this far from the picture, so that an uneven cut leaves none on it.
_GAP_MM = 0.8


def pdf_bytes(poster: Poster, layout: Layout, paper: Paper, dpi: float) -> bytes:
    """All tiles of a poster, row by row, and the overview sheet as the last page.

    Raises:
        PrintError: More pixels on a page than fit into memory.
    """
    document = PdfDocument(f"Attack {poster.attack.attack_id}, {poster.name}")
    for tile in layout.tiles:
        document.add(_tile_page(poster, layout, tile, dpi))
    document.add(overview(poster, layout, paper))
    return document.to_bytes()


def _tile_page(poster: Poster, layout: Layout, tile: Tile, dpi: float) -> Page:
    corner = (layout.margin_mm, layout.margin_mm)
    page = Page(layout.page_mm, (*corner, *layout.tile_mm))
    box_mm = (tile.left_mm, tile.top_mm, *layout.tile_mm)
    page.image(corner, layout.tile_mm, poster.pixels(box_mm, pixels_of(layout.tile_mm, dpi)))
    if layout.margin_mm:  # a page of the poster's own size has no room for marks
        _crop_marks(page, layout)
        _glue_marks(page, layout, tile)
        _footer(page, poster, layout, tile)
    return page


def _crop_marks(page: Page, layout: Layout) -> None:
    """Two lines at each corner of the tile, outside of it."""
    left, top = layout.margin_mm, layout.margin_mm
    right, bottom = left + layout.tile_mm[0], top + layout.tile_mm[1]
    reach = 0.5 * layout.margin_mm  # printers leave the outer 4 mm white
    for x, outwards in ((left, -1), (right, 1)):
        for y in (top, bottom):
            page.line((x + outwards * _GAP_MM, y), (x + outwards * reach, y))
    for y, outwards in ((top, -1), (bottom, 1)):
        for x in (left, right):
            page.line((x, y + outwards * _GAP_MM), (x, y + outwards * reach))


def _glue_marks(page: Page, layout: Layout, tile: Tile) -> None:
    """Dashes where the next tiles begin, on top of what this one repeats of them."""
    if not layout.overlap_mm:
        return
    start, reach = layout.margin_mm, 0.5 * layout.margin_mm
    right, bottom = start + layout.tile_mm[0], start + layout.tile_mm[1]
    x, y = start + layout.step_mm[0], start + layout.step_mm[1]
    if tile.column + 1 < layout.columns:
        page.line((x, start - _GAP_MM), (x, start - reach), dashed=True)
        page.line((x, bottom + _GAP_MM), (x, bottom + reach), dashed=True)
        page.text((x + 0.6, start - 1.0), "glue", 4.5)
    if tile.row + 1 < layout.rows:
        page.line((start - _GAP_MM, y), (start - reach, y), dashed=True)
        page.line((right + _GAP_MM, y), (right + reach, y), dashed=True)
        page.text((right + 0.6, y + 2.2), "glue", 4.5)


def _footer(page: Page, poster: Poster, layout: Layout, tile: Tile) -> None:
    left, bottom = layout.margin_mm, layout.page_mm[1] - layout.margin_mm
    ruler(page, (left, bottom - 2.5))
    x = left + RULER_MM + 3.0
    where = f"row {tile.row + 1} of {layout.rows}, column {tile.column + 1} of {layout.columns}"
    page.text((x, bottom - FOOTER_MM + 6.6), f"{where}, attack {poster.attack.attack_id}", 7.0)
    page.text((x, bottom), "Ruler: 100 mm. Print at 100 %, no fit to page.", 7.0)
    _up(page, (layout.page_mm[0] - layout.margin_mm - 6.0, bottom))


def _up(page: Page, foot: tuple[float, float]) -> None:
    """An arrow to the upper edge of the paper."""
    x, y = foot
    page.line((x, y), (x, y - 4.5), 0.3)
    for side in (-1, 1):
        page.line((x, y - 4.5), (x + side, y - 3.0), 0.3)
    page.text((x + 1.2, y), "UP", 7.0, bold=True)
