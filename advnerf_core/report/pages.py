"""What all pages share: one head, the first screen with what happened, a list of contents, and the film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import Film
from advnerf_core.report.palette import look_css

HOW = "How it was run"
# Films beyond this stay beside the page: browsers open a 20 MB page at once, but not a 200 MB page.
MAX_EMBEDDED_BYTES = 12_000_000
_QUALITY = 85


@dataclass(frozen=True, eq=False)
class FirstScreen:
    """What a page opens with.

    Attributes:
        above: The drives from above, as SVG that is marked safe.
        more: Further sentences, each with the name of what it is about.
    """

    sentence: str
    film: Film | None = None
    film_caption: str = ""
    above: str = ""
    above_caption: str = ""
    more: Sequence[tuple[str, str]] = ()


def fragments(name: str, **values: Any) -> Any:
    """The macros of a template beside this file; ``values`` are its global names."""
    return _environment().get_template(name).make_module({"style_of": style_of, "film_of": film_of, **values})


def render(
    first: FirstScreen,
    sections: Sequence[tuple[str, Markup]],
    badge: tuple[str, str] = ("report", ""),
    about: Sequence[str] = (),
    warnings: Sequence[str] = (),
) -> str:
    """A page as HTML text. It loads nothing but files beside it, and runs no code.

    Args:
        first: What it opens with.
        sections: Heading and HTML of each; one named `HOW` is linked from the top.
        badge: Kind of the page, and its CSS class.
        about: Short facts for the line above the sentence.
        warnings: What a reader must know before anything else.
    """
    style = files("advnerf_core.report").joinpath("page.css").read_text(encoding="utf-8")
    return _environment().get_template("page.html").render(
        first=first,
        sections=sections,
        badge=badge,
        about=about,
        warnings=warnings,
        how=HOW,
        film_of=film_of,
        look=Markup(look_css()),
        style=Markup(style),
    )  # fmt: skip


def fits(film: Film | None, room: int = MAX_EMBEDDED_BYTES) -> bool:
    """Whether a film is embedded."""
    return film is not None and film.file.stat().st_size <= room


def film_of(film: Film) -> dict[str, Any]:
    """A film for a template: its address, its poster at the largest deviation, and its size [px]."""
    from advnerf_core.report.clips import film_uri, frame_of, image_uri  # video codecs and matplotlib

    still = frame_of(film.file, film.moment)
    shown = {"uri": film_uri(film.file), "poster": image_uri(still, quality=_QUALITY), "titles": film.titles}
    return {**shown, "height": still.shape[0], "width": still.shape[1]}


@cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("advnerf_core.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
