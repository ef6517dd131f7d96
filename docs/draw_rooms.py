"""Draws the rooms of the house from the code: ``make rooms`` (or ``python docs/draw_rooms.py``).

A room is a sub-package, or a module that stands beside them; an arrow is an import, wherever in the file it stands, those for type
checkers left out. Arrows that follow from others are not drawn. Writes ``docs/rooms_PACKAGE.svg``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path

import grimp

from advnerf_core.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")
DRAWN = ("nodes", "hardware", "advnerf_core")
PROCESSES = "processes"
# These two run a search and whole drives, so that they stand above the rooms that search and drive.
_CONDUCTORS = ("attack", "collect")
_BOX_W, _BOX_H, _PASSAGE_W, _GAP_X, _GAP_Y, _MARGIN = 118, 34, 6, 16, 46, 16
_SWEEPS = 12
_STYLE = "font: 13px sans-serif; fill: #1f2933"


def survey(package: str, graph: grimp.ImportGraph) -> dict[str, frozenset[str]]:
    """The rooms of a package, and which rooms each one imports from."""
    arrows: dict[str, set[str]] = {}
    for module in sorted(graph.modules):
        name = _room(package, module)
        if name is None:
            continue
        arrows.setdefault(name, set())
        for imported in graph.find_modules_directly_imported_by(module):
            other = _room(package, imported)
            if other is not None and other != name:
                arrows[name].add(other)
    return {name: frozenset(found) for name, found in arrows.items()}


def _room(package: str, module: str) -> str | None:
    parts = module.split(".")
    if parts[0] != package or len(parts) < 2:
        return None
    if package == "nodes" and parts[1] not in _CONDUCTORS and not (ROOT / "nodes" / parts[1]).is_dir():
        return PROCESSES
    return parts[1]


def reduced(arrows: Mapping[str, frozenset[str]]) -> dict[str, set[str]]:
    """The arrows that do not follow from others."""
    reach = {name: set(found) for name, found in arrows.items()}
    for _ in reach:
        for name in reach:
            reach[name] = (
                reach[name].union(*(reach[other] for other in arrows[name])) if arrows[name] else set()
            )
    return {
        name: {
            other for other in found if not any(other in reach[third] for third in found if third != other)
        }
        for name, found in arrows.items()
    }


def floors(arrows: Mapping[str, frozenset[str]]) -> list[list[str]]:
    """Rooms by floor, the roof first: each room stands above all that it imports. A circle is an error."""
    height: dict[str, int] = {}

    def climb(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            raise ValueError(f"expected no circle of imports, got {' -> '.join((*above, name))}")
        if name not in height:
            height[name] = 1 + max((climb(other, (*above, name)) for other in arrows[name]), default=-1)
        return height[name]

    for name in arrows:
        climb(name, ())
    return [
        sorted(name for name in arrows if height[name] == level)
        for level in range(max(height.values()), -1, -1)
    ]


def draw(arrows: Mapping[str, frozenset[str]]) -> str:
    """The rooms as an SVG picture."""
    rows, lines = _laid_out(arrows)
    place, width = _places(rows)
    height = 2 * _MARGIN + len(rows) * (_BOX_H + _GAP_Y) - _GAP_Y
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}">',
        '<defs><marker id="a" markerWidth="8" markerHeight="8" refX="7" refY="3.5" orient="auto">'
        '<path d="M0,0 L7,3.5 L0,7 z" fill="#7b8794"/></marker></defs>',
        f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>',
    ]
    for line in lines:
        (x, y), *others = (place[stop] for stop in line)
        path = [f"M{x:g},{y + _BOX_H:g}"]
        for nx, ny in others:
            middle = (y + _BOX_H + ny) / 2
            path.append(f"C{x:g},{middle:g} {nx:g},{middle:g} {nx:g},{ny:g}")
            path.append(f"L{nx:g},{ny + _BOX_H:g}")  # between the boxes of a floor that it only passes
            x, y = nx, ny
        parts.append(f'<path d="{" ".join(path[:-1])}" fill="none" stroke="#7b8794" marker-end="url(#a)"/>')
    for name in sorted(arrows):
        x, y = place[name]
        parts.append(
            f'<rect x="{x - _BOX_W / 2:g}" y="{y:g}" width="{_BOX_W}" height="{_BOX_H}" rx="4" fill="#e6f0fa" stroke="#486581"/>'
            f'<text x="{x:g}" y="{y + _BOX_H / 2 + 5:g}" text-anchor="middle" style="{_STYLE}">{escape(name)}</text>'
        )
    return "\n".join([*parts, "</svg>", ""])


def _laid_out(arrows: Mapping[str, frozenset[str]]) -> tuple[list[list[str]], list[list[str]]]:
    """Rooms and passages of each floor from left to right, and each arrow as the names it goes by.

    An arrow over several floors gets a passage on each of those between (Sugiyama's layered drawing). Everything then moves towards
    the mean place of what it is joined to, which leaves few crossings.
    """
    rows = floors(arrows)
    floor = {name: number for number, row in enumerate(rows) for name in row}
    lines = []
    for name, found in sorted(reduced(arrows).items()):
        for other in sorted(found):
            passages = [f"{name}>{other} {number}" for number in range(floor[name] + 1, floor[other])]
            for number, passage in enumerate(passages, floor[name] + 1):
                rows[number].append(passage)
            lines.append([name, *passages, other])
    joined: dict[str, list[str]] = {}
    for line in lines:
        for upper, lower in pairwise(line):
            joined.setdefault(upper, []).append(lower)
            joined.setdefault(lower, []).append(upper)
    for _ in range(_SWEEPS):
        for row in rows:
            place, _ = _places(rows)
            middle = {
                name: _mean([place[o][0] for o in joined.get(name, [])], place[name][0]) for name in row
            }
            row.sort(key=middle.__getitem__)
    return rows, lines


def _places(rows: list[list[str]]) -> tuple[dict[str, tuple[float, int]], int]:
    """Middle of the upper edge of everything [px], and the width of the picture [px]."""
    widths = [[_PASSAGE_W if ">" in name else _BOX_W for name in row] for row in rows]
    totals = [sum(found) + _GAP_X * (len(found) - 1) for found in widths]
    width = 2 * _MARGIN + max(totals)
    place = {}
    for number, row in enumerate(rows):
        x = (width - totals[number]) / 2
        for name, wide in zip(row, widths[number], strict=True):
            place[name] = (x + wide / 2, _MARGIN + number * (_BOX_H + _GAP_Y))
            x += wide + _GAP_X
    return place, width


def _mean(values: Sequence[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def written() -> dict[Path, str]:
    """What every file should hold, from the code as it is now."""
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)
    return {ROOT / "docs" / f"rooms_{package}.svg": draw(survey(package, graph)) for package in DRAWN}


def main() -> None:
    """Write the pictures."""
    for file, text in written().items():
        write_atomically(file, text)
        print(f"wrote {file.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
