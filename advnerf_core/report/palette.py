"""The palette of plots, page and clips. Conditions differ in lightness as well as hue, and plots add line style and marker.

The keys are also the names of the page's CSS variables: a figure drawn in the light palette is re-coloured by `themed_svg`.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files

from advnerf_core.report.conditions import CONDITIONS, SPARE

# Light and dark, of what figures draw besides the conditions.
_DRAWN = {
    "ink": ("#1c2128", "#e4e8ec"),
    "muted": ("#59626d", "#9da7b1"),
    "grid": ("#dde2e7", "#30373f"),
    "band": ("#eaf1ec", "#1d2a24"),
    "tape": ("#3f9b6b", "#52b788"),
    "paper": ("#fffffe", "#14181c"),
}
# Colours that figures do not use: boxes, marks of good and bad, focus and buttons.
_SURFACE = {
    "panel": ("#f7f8f9", "#1b2026"),
    "good": ("#1c7245", "#5ccb8f"),
    "bad": ("#b0123c", "#ff8296"),
    "stop": ("#b0123c", "#d3204a"),
    "on-stop": ("#ffffff", "#ffffff"),
    "warn": ("#8a5a00", "#ffc46b"),
    "accent": ("#00695c", "#4db6a4"),
    "on-accent": ("#ffffff", "#04211c"),
}
_PAIRS = {key: (style.light, style.dark) for key, style in {**CONDITIONS, **SPARE}.items()} | _DRAWN
LIGHT, DARK = ({name: pair[at] for name, pair in _PAIRS.items()} for at in (0, 1))
# Of pages: everything.
PAGE_LIGHT, PAGE_DARK = ({name: pair[at] for name, pair in {**_PAIRS, **_SURFACE}.items()} for at in (0, 1))

LINE_STYLES = {"surrogate": "--", "deployed": "-"}


def css_variables(palette: Mapping[str, str]) -> str:
    """The palette as CSS custom properties."""
    return " ".join(f"--{name}: {colour};" for name, colour in palette.items())


def look_css() -> str:
    """The common style sheet of all pages: the palette in both themes, and ``look.css``."""
    light, dark = css_variables(PAGE_LIGHT), css_variables(PAGE_DARK)
    shared = files("advnerf_core.report").joinpath("look.css").read_text(encoding="utf-8")
    return f":root {{ {light} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n{shared}"


def themed_svg(svg: str) -> str:
    """Replace the light palette's colours in an SVG by CSS variables, so that it follows the page's theme."""
    for name, colour in LIGHT.items():
        svg = svg.replace(colour, f"var(--{name})")
    return svg
