"""The table of results for readers: in the terminal, as CSV, Markdown and JSON, and as a page with the drives' clips."""

from __future__ import annotations

import csv
import io
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.evidence.words import DOMAIN_TITLES, NOT_DRIVEN, collisions, excess_cells
from advnerf_core.report.palette import look_css
from advnerf_core.report.result_table import ResultTable, TableRow
from advnerf_core.report.targets import Target, target_table, verdict
from advnerf_core.report.text_table import Table, number

SCHEMA = "advnerf-results/2"
STRAYED_FROM = 1.5
_LEAD = "Every scenario, victim and method, in the learned scene and where it is deployed."
OUTCOMES = (LEFT, RAN_INTO, STRAYED, HELD) = (
    "left the track",
    "ran into something",
    "strayed",
    "held its course",
)
_EXPLAINED = {
    LEFT: "The drive left its track at least once.",
    RAN_INTO: "The drive ended at an obstacle, on the track as the protocol counts it.",
    STRAYED: f"Total CTE at least {STRAYED_FROM:g} times that of the same drive without attack, on the track.",
    HELD: "None of these; drives without attack belong here.",
}
_FIRST_NUMBER, _SAYS_NOTHING = 4, ("", NOT_DRIVEN)
LEGEND = (
    "Total CTE: mean over all drives, and past the plain object from the same starts. Excess: mean |CTE| per tick minus that of a control from "
    "the same start, past the plain object or with no object; the row of the plain object has its mean |CTE|. Intervals are nominal 95 % over "
    "searches and starts, where there are enough. Seeds, and victims, may be of several builds of scene and policies: each cell's JSON has their "
    "digests, as far as they were kept."
)


@dataclass(frozen=True)
class ShownClip:
    """A clip of a cell.

    Attributes:
        cell: Name of the drive's cell.
        outcome: One of `OUTCOMES`.
        file: Path relative to the page.
    """

    cell: CellResult
    outcome: str
    file: str

    @property
    def caption(self) -> str:
        """Caption of the clip."""
        drives = self.cell.deployed or self.cell.surrogate
        return (
            f"total CTE {sum(drives.total_cte_m):.2f} m, without attack {sum(drives.none_total_cte_m):.2f} m"
        )


def outcome_of(cell: CellResult) -> str:
    """Outcome of a cell's deployed drives; of the surrogate's if it was not deployed."""
    drives = cell.deployed or cell.surrogate
    if any(drives.off_track):
        return LEFT
    if any(cell.obstacles("deployed")):
        return RAN_INTO
    strayed = sum(drives.total_cte_m) >= STRAYED_FROM * sum(drives.none_total_cte_m)
    return STRAYED if strayed and cell.method != NONE else HELD


def text_table(table: ResultTable) -> Table:
    """All lines as text."""
    columns = (
        "path or variant",
        "victim",
        "object shows",
        "driven in",
        "seeds",
        "total CTE [m]",
        "plain object [m]",
        "excess [m per tick]",
        "95 %",
        "over no object",
        "95 % of it",
        "off track",
        "collided",
    )
    cells, groups, classes = [], [], []
    last: TableRow | None = None
    for index, row in enumerate(table.rows):
        new_scenario = last is None or row.key[:2] != last.key[:2]
        new_victim = last is None or row.key[:3] != last.key[:3]
        if new_victim:
            groups.append(index)
        where = f"{row.scenario}, {row.placement}" if row.placement else row.scenario
        name = style_of(row.method).title if row.domain == "surrogate" else ""
        cells.append((where if new_scenario else "", row.victim if new_victim else "", name, *_numbers(row)))
        classes.append(row.method if row.seeds else "unmeasured")
        last = row
    # Drop a column that is empty in all lines, such as a control without drives.
    kept = [index for index in range(len(columns)) if any(row[index] not in _SAYS_NOTHING for row in cells)]
    return Table(
        "Results",
        tuple(columns[index] for index in kept),
        tuple(tuple(row[index] for index in kept) for row in cells),
        tuple(index >= _FIRST_NUMBER for index in kept),
        tuple(groups),
        tuple(classes),
    )


def not_driven(table: ResultTable) -> str:
    """Names the cells that live nodes could not drive, and the consequence; empty if all were driven."""
    missing = [cell for cell in table.cells.values() if cell.not_driven_live]
    if not missing:
        return ""
    arms = ", ".join(f"{style_of(cell.method).title} ({cell.victim}, seed {cell.seed})" for cell in missing)
    return (
        f"NOT DRIVEN LIVE: {arms}. Load or a fault of the stack spoiled every try, at last: {missing[-1].not_driven_live}. These arms have only "
        "the synchronous drives in the learned scene, which are no evidence of transfer. On a machine without other load, give the command "
        "again with --retry."
    )


def _numbers(row: TableRow) -> tuple[str, ...]:
    begin = DOMAIN_TITLES[row.domain], f"{len(row.seeds)} of {len(row.seeds) + len(row.missing)}"
    if not row.seeds:
        return (*begin, "missing", *[""] * 7)
    total = number(row.total_m) + ("" if row.total_std_m is None else f" ± {row.total_std_m:.2f}")
    excess = excess_cells(vars(row.excess)) if row.excess else ("", "", "", "")
    hit = collisions(row.excess.collided) if row.excess else ""
    return (*begin, total, number(row.plain_total_m), *excess, f"{row.off_track} of {row.drives}", hit)


def as_json(table: ResultTable, targets: Sequence[Target] = ()) -> dict[str, Any]:
    """Lines, targets and cells as JSON-ready values."""
    return {
        "schema": SCHEMA,
        "name": table.name,
        "rows": [row.record() for row in table.rows],
        "targets": [target.record() for target in targets],
        "cells": {name: cell.model_dump(mode="json") for name, cell in table.cells.items()},
    }


def as_csv(table: ResultTable) -> str:
    """The lines, one column per number; missing numbers are empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    records = [row.record() for row in table.rows]
    columns = list(records[0] if records else {})
    writer.writerow(columns)
    for record in records:
        writer.writerow([_field(record[name]) for name in columns])
    return stream.getvalue()


def _field(value: Any) -> Any:
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    if isinstance(value, dict):
        return " ".join(f"{name}:{count}" for name, count in value.items())
    return "" if value is None else value


def as_markdown(table: ResultTable, targets: Sequence[Target] = ()) -> str:
    """Lines and targets as a Markdown page."""
    parts = [f"# {table.name or 'Results'}\n", f"{LEGEND}\n", text_table(table).markdown()]
    if targets:
        parts += ["## Targets\n", target_table(targets).markdown()]
    return "\n".join(parts)


def gather_clips(table: ResultTable, cells_folder: Path, page_folder: Path) -> list[ShownClip]:
    """Put the cells' clips beside the page, in one folder per outcome; as hard links if the disk has the file.

    Args:
        table: The table with the cells.
        cells_folder: Folder that the cells' clip names are relative to.
        page_folder: Folder of the page; older clips in its ``videos`` are deleted.
    """
    shutil.rmtree(page_folder / "videos", ignore_errors=True)
    shown = []
    for name, cell in table.cells.items():
        clip = cell.extra.get("clip")
        source = cells_folder / clip if isinstance(clip, str) else None
        if source is None or not source.is_file():
            continue
        outcome = outcome_of(cell)
        target = page_folder / "videos" / outcome.replace(" ", "_") / f"{name}{source.suffix}"
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)
        shown.append(ShownClip(cell, outcome, target.relative_to(page_folder).as_posix()))
    return shown


def render_page(
    table: ResultTable,
    clips: Sequence[ShownClip] = (),
    sections: Sequence[tuple[str, Markup]] = (),
    lead: Sequence[str | Markup] = (),
    targets: Sequence[Target] = (),
) -> str:
    """The page as HTML text; it loads nothing but the clips beside it.

    Args:
        table: The table.
        clips: Clips beside the page.
        sections: Further parts: heading and HTML.
        lead: Paragraphs, or HTML, before the table; empty for the standard introduction.
        targets: Targets of the results.
    """
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    resources = files("advnerf_core.report")
    template = environment.from_string(resources.joinpath("page.html").read_text(encoding="utf-8"))
    groups = [(name, _EXPLAINED[name], [clip for clip in clips if clip.outcome == name]) for name in OUTCOMES]
    return template.render(
        name=table.name or "Results",
        legend=LEGEND,
        style=Markup(resources.joinpath("page.css").read_text(encoding="utf-8")),
        look=Markup(look_css()),
        table=text_table(table).html(),
        targets=target_table(targets).html() if targets else "",
        headlines=[target for target in targets if target.headline],
        verdict=verdict(targets),
        not_driven=not_driven(table),
        lead=lead or (_LEAD,),
        missing=sum(len(row.missing) for row in table.rows if row.domain == "surrogate"),
        cells=len(table.cells),
        machines=sorted({cell.machine for cell in table.cells.values()}),
        clips=clips,
        groups=groups,
        sections=sections,
        style_of=style_of,
    )
