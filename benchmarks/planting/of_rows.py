"""Changes of rows of the ledger, with their pages renewed, and of hand-written pages."""

from __future__ import annotations

import re
from collections.abc import Callable

from advnerf_core.documents import read_json
from benchmarks.kept_commands import kept_by
from benchmarks.planting.world import Data, World

_FIGURE = re.compile(r"\d+\.\d+(?= (?:m|%|x|dB|ms)(?!\w))")


def a_missed_row(world: World) -> None:
    """A missed row is gone."""
    rows = read_json(world.ledger)
    rows.remove(world.rng.choice([row for row in rows if row["met"] is False]))
    world.renew_rows(rows)


def a_missed_row_is_committed(world: World) -> None:
    """A missed row is gone, and that is committed."""
    a_missed_row(world)
    world.commit(".")


def a_verdict(world: World) -> None:
    """A missed row that says it was met."""
    rows = read_json(world.ledger)
    world.rng.choice([row for row in rows if row["met"] is False])["met"] = True
    world.renew_rows(rows)


def a_kept_value(world: World) -> None:
    """Another value of a row whose drives are kept."""
    _value(world, lambda row: kept_by(row["command"]) is not None)


def a_value(world: World) -> None:
    """Another value of a row that was measured once."""
    _value(world, lambda row: kept_by(row["command"]) is None)


def a_value_of_another_day(world: World) -> None:
    """Another value of a row that was measured once, as if it were measured again."""
    _value(world, lambda row: kept_by(row["command"]) is None, date="2026-12-01T00:00:00+00:00")


def a_row_without_its_page(world: World) -> None:
    """Another note of a row, whose page is not renewed."""
    rows = read_json(world.ledger)
    world.rng.choice(rows)["note"] += "; all is well"
    world.put(world.ledger, rows)


def a_figure_on_a_page(world: World) -> None:
    """Another figure on a hand-written page."""
    pages = [world.root / "README.md", *sorted((world.root / "docs").glob("p*.md"))]
    page = world.rng.choice([each for each in pages if _FIGURE.search(each.read_text())])
    text = page.read_text()
    place = world.rng.choice(list(_FIGURE.finditer(text)))
    other = f"{float(place[0]) * world.rng.uniform(1.7, 5.0):.{len(place[0].split('.')[1])}f}"
    page.write_text(text[: place.start()] + other + text[place.end() :])


def _value(world: World, wanted: Callable[[Data], bool], **more: str) -> None:
    rows = read_json(world.ledger)
    row: Data = world.rng.choice(
        [each for each in rows if wanted(each) and isinstance(each["value"], float) and each["value"]]
    )
    row["value"] *= 1.0 + world.rng.choice([-1, 1]) * world.rng.uniform(0.02, 0.1)
    row |= more
    world.renew_rows(rows)
