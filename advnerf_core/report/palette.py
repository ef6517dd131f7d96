"""The palette of plots, page and clips. Conditions differ in lightness as well as hue, and plots add line style and marker.

The keys are also the names of the page's CSS variables: a figure drawn in the light palette is re-coloured by `themed_svg`.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from types import MappingProxyType

from advnerf_core.report.conditions import CONDITIONS, SPARE

_STYLES = {**CONDITIONS, **SPARE}
LIGHT: Mapping[str, str] = MappingProxyType(
    {
        **{key: style.light for key, style in _STYLES.items()},
        "ink": "#1c2128",
        "muted": "#59626d",
        "grid": "#dde2e7",
        "band": "#eaf1ec",
        "tape": "#3f9b6b",
        "paper": "#fffffe",
    }
)
DARK: Mapping[str, str] = MappingProxyType(
    {
        **{key: style.dark for key, style in _STYLES.items()},
        "ink": "#e4e8ec",
        "muted": "#9da7b1",
        "grid": "#30373f",
        "band": "#1d2a24",
        "tape": "#52b788",
        "paper": "#14181c",
    }
)

# Colours that plots do not use: boxes, marks of good and bad, focus and buttons.
SURFACE_LIGHT: Mapping[str, str] = MappingProxyType(
    {
        "panel": "#f7f8f9",
        "good": "#1c7245",
        "bad": "#b0123c",
        "stop": "#b0123c",
        "on-stop": "#ffffff",
        "warn": "#8a5a00",
        "accent": "#00695c",
        "on-accent": "#ffffff",
    }
)
SURFACE_DARK: Mapping[str, str] = MappingProxyType(
    {
        "panel": "#1b2026",
        "good": "#5ccb8f",
        "bad": "#ff8296",
        "stop": "#d3204a",
        "on-stop": "#ffffff",
        "warn": "#ffc46b",
        "accent": "#4db6a4",
        "on-accent": "#04211c",
    }
)

LINE_STYLES: Mapping[str, str] = MappingProxyType({"surrogate": "--", "deployed": "-"})


def css_variables(palette: Mapping[str, str]) -> str:
    """The palette as CSS custom properties."""
    return " ".join(f"--{name}: {colour};" for name, colour in palette.items())


def look_css() -> str:
    """The common style sheet of all pages: the palette in both themes, and ``look.css``."""
    light, dark = css_variables({**LIGHT, **SURFACE_LIGHT}), css_variables({**DARK, **SURFACE_DARK})
    shared = files("advnerf_core.report").joinpath("look.css").read_text(encoding="utf-8")
    return f":root {{ {light} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n{shared}"


def themed_svg(svg: str) -> str:
    """Replace the light palette's colours in an SVG by CSS variables, so that it follows the page's theme."""
    for name, colour in LIGHT.items():
        svg = svg.replace(colour, f"var(--{name})")
    return svg
