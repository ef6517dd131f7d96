"""The overview sheet of a printed attack: tiles, print settings, mounting, and a strip of known colours."""

from __future__ import annotations

import math

import numpy as np

from advnerf_core.attack.printing.pdf import Page
from advnerf_core.attack.printing.poster import Poster
from advnerf_core.attack.printing.tiles import PAPERS_MM, Layout, Paper
from advnerf_core.geometry import yaw_of

RULER_MM = 100.0
# The sRGB values of the colour strip: greys from paper white to black, and the corners of what a printer can mix.
PATCHES = (
    (255, 255, 255),
    (192, 192, 192),
    (128, 128, 128),
    (64, 64, 64),
    (0, 0, 0),
    (255, 0, 0),
    (0, 255, 0),
    (0, 0, 255),
)
PATCH_MM = 20.0
_LEFT_MM, _PITCH_MM, _PICTURE_MM, _PICTURE_PX = 15.0, 22.5, 80.0, 600
_LINE_MM = 4.8
_UPRIGHT_RAD = math.radians(0.5)


def overview(poster: Poster, layout: Layout, paper: Paper) -> Page:
    """The sheet, on A4 or Letter."""
    page = Page(PAPERS_MM["letter" if paper in ("letter", "tabloid") else "a4"])
    page.text((_LEFT_MM, 20.0), f"Attack {poster.attack.attack_id}: {poster.name}", 15.0, bold=True)
    page.text((_LEFT_MM, 26.5), f"{_sizes(poster)} at true size, {_victim(poster)}", 10.0)
    top = 32.0 + _picture(page, poster, layout, 32.0)
    for title, lines in (
        ("Print", _print_lines(layout, paper)),
        ("Mount", _mount_lines(poster)),
        ("Check the colours", _colour_lines()),
    ):
        top = _paragraph(page, top + 4.0, title, lines)
    _colour_strip(page, top + 2.0)
    ruler(page, (_LEFT_MM, top + PATCH_MM + 16.0))
    page.text((_LEFT_MM + RULER_MM + 3.0, top + PATCH_MM + 16.0), "This ruler is 100 mm long.", 8.0)
    return page


def ruler(page: Page, start: tuple[float, float]) -> None:
    """A ruler of 100 mm from the left end of its line, with ticks of 10 mm."""
    x, y = start
    page.line((x, y), (x + RULER_MM, y), 0.15)
    for each in range(0, int(RULER_MM) + 1, 10):
        page.line((x + each, y), (x + each, y - (2.5 if each % 50 == 0 else 1.5)), 0.15)


def _picture(page: Page, poster: Poster, layout: Layout, top_mm: float) -> float:
    """The poster with the grid of its tiles; its height [mm]."""
    width, height = poster.sheet_mm
    scale = _PICTURE_MM / max(width, height)
    pixels = tuple(max(1, round(_PICTURE_PX * each / max(width, height))) for each in (width, height))
    shown = (scale * width, scale * height)
    page.image((_LEFT_MM, top_mm), shown, poster.pixels((0.0, 0.0, width, height), (pixels[0], pixels[1])))
    page.box((_LEFT_MM, top_mm), shown)
    for column in range(1, layout.columns):
        x = _LEFT_MM + scale * column * layout.step_mm[0]
        page.line((x, top_mm), (x, top_mm + shown[1]))
    for row in range(1, layout.rows):
        y = top_mm + scale * row * layout.step_mm[1]
        page.line((_LEFT_MM, y), (_LEFT_MM + shown[0], y))
    page.text((_LEFT_MM + shown[0] + 4.0, top_mm + 4.0), "UP: this edge on top", 9.0, bold=True)
    for number, line in enumerate(_about(poster, layout)):
        page.text((_LEFT_MM + shown[0] + 4.0, top_mm + 12.0 + number * _LINE_MM), line)
    return shown[1]


def _about(poster: Poster, layout: Layout) -> list[str]:
    attack = poster.attack
    total = attack.predicted_total_cte_m
    return [
        f"{layout.rows * layout.columns} tiles: {layout.rows} rows of {layout.columns}",
        f"tile {layout.tile_mm[0]:.1f} x {layout.tile_mm[1]:.1f} mm, overlap {layout.overlap_mm:g} mm",
        f"method {attack.method}, seed {attack.seed}",
        f"scene {attack.scene_sha256[:12]}",
        "predicted total CTE " + ("unknown" if total is None else f"{total:.2f} m"),
    ]


def _print_lines(layout: Layout, paper: Paper) -> list[str]:
    if paper == "none":
        return ["Page 1 is the poster, at its true size. Print at 100 %, without bleed, on matte material."]
    upright = "portrait" if layout.page_mm[0] < layout.page_mm[1] else "landscape"
    glue = "Put each tile on the strip marked 'glue' of the tile to its left or above it."
    return [
        f"Paper {paper.title()}, {upright}. Matte paper. 100 % (actual size), no fit to page, one-sided, colours as sRGB.",
        "Measure the ruler of the first page: if it is not 100 mm long, the printer scaled it. Print again.",
        f"Cut each tile at its crop marks. {glue}"
        if layout.overlap_mm
        else "Cut each tile at its crop marks.",
    ]


def _mount_lines(poster: Poster) -> list[str]:
    """Mounting position of the poster, from the attack file's pose; in the scene's frames."""
    T = np.asarray(poster.T_world_from_face)
    x, y, z = T[:3, 3]
    half = 0.5 * poster.size_m[1] * T[2, 2]
    lower, upper = (round(float(edge), 3) + 0.0 for edge in (z - half, z + half))  # no minus before a zero
    edge = "Lower edge" if poster.frame is None else "The picture's lower edge, without its markers,"
    lines = [
        f"Centre at x = {x:.3f} m, y = {y:.3f} m in the scene's frame, {z:.3f} m above its floor (z = 0).",
        f"{edge} at {lower:.3f} m, upper edge at {upper:.3f} m.",
    ]
    if abs(math.asin(np.clip(T[2, 0], -1.0, 1.0))) < _UPRIGHT_RAD and T[2, 2] > math.cos(_UPRIGHT_RAD):
        heading = round(math.degrees(yaw_of(T)), 1) + 0.0
        return [
            *lines,
            f"Upright. It faces {heading:.1f} degrees, counter-clockwise from the frame's x axis.",
        ]
    facing, up = (", ".join(f"{value:.3f}" for value in T[:3, axis]) for axis in (0, 2))
    return [*lines, f"Not upright. It faces ({facing}), and its upper edge points to ({up})."]


def _colour_lines() -> list[str]:
    return [
        "Photograph the strip beside the poster, in the light of the test. Below each patch is its sRGB value.",
    ]


def _colour_strip(page: Page, top_mm: float) -> None:
    for number, colour in enumerate(PATCHES):
        x = _LEFT_MM + number * _PITCH_MM
        page.box((x, top_mm), (PATCH_MM, PATCH_MM), colour)
        page.text((x, top_mm + PATCH_MM + 4.0), " ".join(map(str, colour)), 8.0)


def _paragraph(page: Page, top_mm: float, title: str, lines: list[str]) -> float:
    """A title and lines; returns where the next paragraph begins [mm]."""
    page.text((_LEFT_MM, top_mm + 5.0), title, 11.0, bold=True)
    for number, line in enumerate(lines):
        page.text((_LEFT_MM, top_mm + 10.5 + number * _LINE_MM), line)
    return top_mm + 10.5 + len(lines) * _LINE_MM - 3.0


def _sizes(poster: Poster) -> str:
    picture = metres(poster.size_m)
    return picture if poster.frame is None else f"{picture}, {metres(poster.frame.sheet_m)} with markers,"


def metres(size_m: tuple[float, float]) -> str:
    """Width and height as text."""
    return f"{size_m[0]:.3f} x {size_m[1]:.3f} m"


def _victim(poster: Poster) -> str:
    victim = poster.attack.extra.get("victim")
    return f"against policy {poster.attack.policy_sha256[:12]}" + (f" ({victim})" if victim else "")
