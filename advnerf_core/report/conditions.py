"""The conditions that drives are compared under, with their names and styles in one table.

A condition says what the objects show: only their own colours (``none``), the result of a method of attack (named by the
method), or a special drive (``empty``, ``laps``). A method outside the table is called by its title or name and gets a spare
style: always the same one, unless two such methods in one table would share it (`know_methods`).
"""

from __future__ import annotations

import colorsys
import zlib
from collections.abc import Iterable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, replace
from types import MappingProxyType

NONE = "none"
EMPTY = "empty"
# Drives without a search: the objects in their own colours, and no objects at all.
CONTROLS = (NONE, EMPTY)


@dataclass(frozen=True)
class Style:
    """Name and style of a condition.

    Attributes:
        key: Name of its colour in the palettes, and of the page's CSS variable.
        light: Colour on a light page, ``#rrggbb``.
        dark: Colour on a dark page, ``#rrggbb``.
        marker: Marker of matplotlib: a name, or corners, kind (0: polygon, 1: star) and angle [deg].
        climbs: Whether each evaluation of its search starts from the one before, so that a line joins them; else they are drawn as dots.
    """

    title: str
    key: str
    light: str
    dark: str
    marker: str | tuple[int, int, int]
    climbs: bool = False


def _rows(*styles: Style) -> Mapping[str, Style]:
    return {style.key: style for style in styles}


# In the order of tables and legends.
CONDITIONS: Mapping[str, Style] = _rows(
    Style("plain object", NONE, "#0072b2", "#4fb0f2", "o"),
    Style("best random", "random", "#dd9300", "#f7cc5a", "s"),
    Style("random, coarse", "random_coarse", "#63470b", "#e99835", (4, 1, 0)),
    Style("random, levels", "random_levels", "#5a5841", "#b8ad79", (4, 1, 45)),
    Style("random, 1/f", "random_pink", "#73852d", "#acbe54", (6, 1, 0)),
    Style("random, natural", "random_natural", "#bdcb58", "#e4eba3", (8, 1, 0)),
    Style("cross-entropy", "cem", "#7a3f98", "#a05ad2", "v"),
    Style("evolution strategy", "evolution", "#006b70", "#2fe0d2", "P"),
    Style("gradient", "gradient", "#b0123c", "#f4577a", "^", climbs=True),
    Style("gradient, coarse", "gradient_coarse", "#671c44", "#b7625b", (3, 1, 0), climbs=True),
    Style("frames alone", "frame", "#591600", "#de3512", (7, 0, 0), climbs=True),
    Style("guided", "guided", "#ef7fb8", "#ffc2e2", "X", climbs=True),
    Style("distilled", "distilled", "#b5895f", "#a87545", "*", climbs=True),
    Style("no object", EMPTY, "#7d848d", "#8f98a3", "D"),
    Style("laps without attack", "laps", "#232c66", "#c3caff", "p"),
)


def _generated(number: int) -> Style:
    """A distinct spare style for each number; hues advance by the golden angle."""
    hue = 0.618034 * number % 1.0
    light, dark = (
        "#" + "".join(f"{round(255 * part):02x}" for part in colorsys.hls_to_rgb(hue, lightness, 0.55))
        for lightness in (0.30, 0.76)
    )
    return Style("", f"spare-{number}", light, dark, (3 + number, 1, 15))


# For methods outside the table; their titles replace the names. The first ones are the most distinct.
_PREFERRED = _rows(
    Style("", "spare-1", "#5c7a00", "#b6d957", "<"),
    Style("", "spare-2", "#a63d00", "#ff9466", ">"),
    Style("", "spare-3", "#00587a", "#5fc3e8", "h"),
    Style("", "spare-4", "#a400a4", "#ec7bec", "d"),
    Style("", "spare-5", "#8f7a00", "#d8c84a", "H"),
    Style("", "spare-6", "#4b3fb5", "#a99cff", "8"),
)
_MOST = 24
SPARE: Mapping[str, Style] = {
    **_PREFERRED,
    **_rows(*(_generated(number) for number in range(len(_PREFERRED) + 1, _MOST + 1))),
}
# Styles of the methods passed to `know_methods`.
_known: ContextVar[Mapping[str, Style]] = ContextVar("_known", default=MappingProxyType({}))


def know_methods(names: Iterable[str], titles: Mapping[str, str] | None = None) -> None:
    """Give the methods of one table distinct colours, from here on in this context.

    The colours depend on all given names, not on their order. With more than 24 methods outside `CONDITIONS`, colours repeat.

    Args:
        names: Conditions of the table; those in `CONDITIONS` keep their style.
        titles: Names for readers; others keep their names.
    """
    known = _known.get()
    styles: dict[str, Style] = {}
    taken: set[str] = set()
    for name in sorted({*names, *known} - set(CONDITIONS)):
        first = _preferred(name)
        free = [each for each in (first, *SPARE.values()) if each.key not in taken]
        chosen = free[0] if free else first
        taken.add(chosen.key)
        title = (titles or {}).get(name) or (known[name].title if name in known else name)
        styles[name] = replace(chosen, title=title)
    _known.set(styles)


def _preferred(name: str) -> Style:
    return tuple(_PREFERRED.values())[zlib.crc32(name.encode()) % len(_PREFERRED)]


def style_of(name: str) -> Style:
    """The style of a condition; an unknown one has its name as title and a spare colour that depends on the name only."""
    if name in CONDITIONS:
        return CONDITIONS[name]
    return _known.get().get(name) or replace(_preferred(name), title=name)


def order_of(name: str) -> tuple[int, str]:
    """Sort key of conditions: methods of the table in its order, then other methods by name, then special drives."""
    names = tuple(CONDITIONS)
    special = names.index(EMPTY)
    if name not in CONDITIONS:
        return special, name
    place = names.index(name)
    return (place if place < special else place + 1), name


def compared(methods: Iterable[str]) -> dict[str, str]:
    """What the first screen of a page compares, in its order: conditions with their titles. The attack is the gradient, or the last method."""
    searched = [name for name in methods if name not in CONTROLS]
    attack = "gradient" if "gradient" in searched else searched[-1]
    random = [name for name in searched if name.startswith("random") and name != attack]
    return {NONE: "no attack", **dict.fromkeys(random[:1], "best random"), attack: "attack"}
