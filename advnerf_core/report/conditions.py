"""What an attacked drive is compared by: the conditions, what they are called, and how they are drawn. The one table of both.

A condition says what the objects show: nothing but their own colours (``none``), what a method of attack found (named by the
method), or a special drive (``empty``, ``laps``). A method that is not in the table is called by its title or name and gets a spare
style: always the same one, unless two such methods of one table would share it (`know_methods`).
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
# Drives that no search belongs to: the objects in their own colours, and no objects at all.
CONTROLS = (NONE, EMPTY)


@dataclass(frozen=True)
class Style:
    """How a condition is called and drawn.

    Attributes:
        title: Its name for readers.
        key: Name of its colour in the palettes, and of the page's CSS variable.
        light: Colour on a light page, ``#rrggbb``.
        dark: Colour on a dark page, ``#rrggbb``.
        marker: Marker of matplotlib: a name, or corners, kind (0: polygon, 1: star) and angle [deg].
        climbs: Whether each evaluation of its search starts from the one before, so that a line joins them; else they are dots.
    """

    title: str
    key: str
    light: str
    dark: str
    marker: str | tuple[int, int, int]
    climbs: bool = False


def _rows(*styles: Style) -> Mapping[str, Style]:
    return MappingProxyType({style.key: style for style in styles})


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
    """A spare style of its own for each number; hues go round by the golden angle."""
    hue = 0.618034 * number % 1.0
    light, dark = (
        "#" + "".join(f"{round(255 * part):02x}" for part in colorsys.hls_to_rgb(hue, lightness, 0.55))
        for lightness in (0.30, 0.76)
    )
    return Style("", f"spare-{number}", light, dark, (3 + number, 1, 15))


# Of methods that the table does not have; the titles stand for their names. The first ones are told apart best.
_PREFERRED = _rows(
    Style("", "spare-1", "#5c7a00", "#b6d957", "<"),
    Style("", "spare-2", "#a63d00", "#ff9466", ">"),
    Style("", "spare-3", "#00587a", "#5fc3e8", "h"),
    Style("", "spare-4", "#a400a4", "#ec7bec", "d"),
    Style("", "spare-5", "#8f7a00", "#d8c84a", "H"),
    Style("", "spare-6", "#4b3fb5", "#a99cff", "8"),
)
_MOST = 24
SPARE: Mapping[str, Style] = MappingProxyType(
    {**_PREFERRED, **_rows(*(_generated(number) for number in range(len(_PREFERRED) + 1, _MOST + 1)))}
)
# Styles of the methods that `know_methods` was told of.
_known: ContextVar[Mapping[str, Style]] = ContextVar("_known", default=MappingProxyType({}))


def know_methods(names: Iterable[str], titles: Mapping[str, str] | None = None) -> None:
    """Give methods that stand in one table colours of their own, from here on in this context.

    The colours depend on all names that were given, not on their order. Above 24 methods that are not in the table, colours repeat.

    Args:
        names: Conditions of the table; those of `CONDITIONS` keep their style.
        titles: What readers call them; others are called by their names.
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
    _known.set(MappingProxyType(styles))


def _preferred(name: str) -> Style:
    return tuple(_PREFERRED.values())[zlib.crc32(name.encode()) % len(_PREFERRED)]


def style_of(name: str) -> Style:
    """The style of a condition; one that is in no table has its name as title and a spare colour that depends on the name only."""
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
