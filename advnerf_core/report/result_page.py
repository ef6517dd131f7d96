"""The table of results for readers: in the terminal, as CSV, Markdown and JSON, and as a page with the drives' clips."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs)

from __future__ import annotations

import csv
import io
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from types import MappingProxyType
from typing import Any

from markupsafe import Markup

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.evidence.words import DOMAIN_TITLES, NOT_DRIVEN, collisions, excess_cells
from advnerf_core.report.pages import FirstScreen, fragments, render
from advnerf_core.report.result_table import ResultTable, TableRow
from advnerf_core.report.targets import Target, target_table, verdict
from advnerf_core.report.text_table import Table, count, number

SCHEMA = "advnerf-results/2"
STRAYED_FROM = 1.5
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
_COLUMNS = (
    "path or variant", "victim", "object shows", "driven in", "searches", "starts", "mean |CTE| [m]", "over the plain object [m]", "95 %",
    "over no object [m]", "95 % of it", "off track", "collided",
)  # fmt: skip
_FIRST_NUMBER = 4
# A column in which all lines say this says nothing.
_SAYS_NOTHING = {"searches": ("", "1"), "over no object [m]": ("", NOT_DRIVEN), "collided": ("", "0")}
LEGEND = (
    "Distances are per control tick. |CTE|: distance from the path, mean over all drives. Over the plain object, and over no object: how much larger "
    "it is than that of the control from the same start. Intervals are nominal 95 % over searches and starts, where there are enough. Seeds, and victims, may be of several builds of scene and policies: each cell's JSON has their "
    "digests, as far as they were kept."
)

MAXIMISED = "What the searches maximised"
_OF_SEARCHES = "The best evaluation of each search in the learned scene, from the starts of the search, mean over searches; larger is a stronger attack."


# Cells by outcome and by the clip's file, relative to the page.
Clips = Mapping[str, Mapping[str, CellResult]]


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
    """All lines in metres, as text. A column that says the same nothing in all lines is left out."""
    cells, groups, classes = [], [], []
    last: TableRow | None = None
    for index, row in enumerate(table.rows):
        new_scenario = last is None or row.scenario != last.scenario
        new_victim = last is None or row.key[:2] != last.key[:2]
        if new_victim:
            groups.append(index)
        name = style_of(row.method).title if row.domain == "surrogate" else ""
        cells.append(
            (row.scenario if new_scenario else "", row.victim if new_victim else "", name, *_numbers(row))
        )
        classes.append(row.method if row.seeds else "unmeasured")
        last = row
    for at, name in enumerate(_COLUMNS):
        if all(row[at] in _SAYS_NOTHING.get(name, ("",)) for row in cells):
            cells = [(*row[:at], "", *row[at + 1 :]) for row in cells]
    right = tuple(at >= _FIRST_NUMBER for at in range(len(_COLUMNS)))
    return Table("Results", _COLUMNS, tuple(cells), right, tuple(groups), tuple(classes))


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
    if not row.seeds:
        return DOMAIN_TITLES[row.domain], "missing", *[""] * 8
    wanted = len(row.seeds) + len(row.missing)
    searches = f"{len(row.seeds)} of {wanted}" if row.missing else str(wanted)
    excess = excess_cells(vars(row.excess)) if row.excess else ("", "", "", "")
    # The plain object exceeds itself by nothing: the column before has its mean |CTE|.
    excess = ("", "", *excess[2:]) if row.method == NONE else excess
    mean = "" if row.mean_abs_cte_m is None else number(row.mean_abs_cte_m, 3)
    hit = collisions(row.excess.collided) if row.excess else ""
    begin = DOMAIN_TITLES[row.domain], searches, str(row.drives // len(row.seeds)), mean
    return *begin, *excess, f"{row.off_track} of {row.drives}", hit


def ratios(table: ResultTable) -> str:
    """Total CTE of each line over that past the plain object, as publications in other units give it; empty without any."""
    rows = [row for row in table.rows if row.ratio is not None and row.method != NONE]
    named = [", ".join((*row.key[:2], style_of(row.method).title)) for row in rows]
    return "; ".join(
        f"{name}, {DOMAIN_TITLES[row.domain]}: {row.ratio:.2f} ×"
        for name, row in zip(named, rows, strict=True)
    )


def maximised(table: ResultTable) -> list[dict[str, Any]]:
    """The objectives of searches for anything but the total CTE, with their values: means over the searches of a path, victim and method.

    Values are those of the best evaluation in the learned scene, from the starts of the search, in the objective's unit; ``clean_value`` is that past the
    plain object, None where it was not kept.
    """
    found: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for cell in table.cells.values():
        if (entry := cell.extra.get("objective")) is not None:
            found.setdefault((*cell.key, entry["name"], entry["unit"]), []).append(entry)
    names = ("scenario", "victim", "method", "objective", "unit")
    return [
        {
            **dict(zip(names, key, strict=True)),
            "searches": len(entries),
            **{name: _mean([entry.get(name) for entry in entries]) for name in ("value", "clean_value")},
        }
        for key, entries in found.items()
    ]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def maximised_table(table: ResultTable) -> Table | None:
    """What `maximised` finds, as text; None if all searches maximised the total CTE."""
    found = maximised(table)
    if not found:
        return None
    columns = (
        "path or variant",
        "victim",
        "object shows",
        "objective",
        "searches",
        "value",
        "plain object",
        "unit",
    )
    rows = tuple(
        (
            each["scenario"],
            each["victim"],
            style_of(each["method"]).title,
            each["objective"],
            str(each["searches"]),
            *("" if value is None else f"{value:.4g}" for value in (each["value"], each["clean_value"])),
            each["unit"],
        )
        for each in found
    )
    right = tuple(name in ("searches", "value", "plain object") for name in columns)
    return Table(MAXIMISED, columns, rows, right)


def as_json(table: ResultTable, targets: Sequence[Target] = ()) -> dict[str, Any]:
    """Lines, targets and cells as JSON-ready values; ``objectives`` if searches maximised something else than the total CTE."""
    objectives = maximised(table)
    return {
        "schema": SCHEMA,
        "name": table.name,
        "rows": [row.record() for row in table.rows],
        **({"objectives": objectives} if objectives else {}),
        "targets": [asdict(target) for target in targets],
        "cells": {name: cell.model_dump(mode="json") for name, cell in table.cells.items()},
    }


def as_csv(table: ResultTable) -> str:
    """The lines, one column per number; missing numbers are empty."""
    stream = io.StringIO()
    records = [{name: _field(value) for name, value in row.record().items()} for row in table.rows]
    writer = csv.DictWriter(stream, records[0] if records else (), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
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
    if (goals := maximised_table(table)) is not None:
        parts += [f"## {MAXIMISED}\n", f"{_OF_SEARCHES}\n", goals.markdown()]
    if targets:
        parts += ["## Targets\n", target_table(targets).markdown()]
    return "\n".join(parts)


def gather_clips(table: ResultTable, cells_folder: Path, page_folder: Path) -> Clips:
    """Put the cells' clips beside the page, in one folder per outcome; as hard links if the disk has the file.

    The clips' names are relative to the folder of the cells. Older clips beside the page are deleted.
    """
    shutil.rmtree(page_folder / "videos", ignore_errors=True)
    shown: dict[str, dict[str, CellResult]] = {name: {} for name in OUTCOMES}
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
        shown[outcome][target.relative_to(page_folder).as_posix()] = cell
    return {outcome: found for outcome, found in shown.items() if found}


def render_page(
    table: ResultTable,
    first: FirstScreen,
    clips: Clips = MappingProxyType({}),
    sections: Sequence[tuple[str, Markup]] = (),
    targets: Sequence[Target] = (),
    notes: Sequence[str] = (),
) -> str:
    """The page as HTML text; it loads nothing but the clips beside it.

    Its notes are what a reader must know first, such as what is left out.
    """
    parts = fragments("results.html", clips=clips, explained=_EXPLAINED)
    shown = Markup(parts.table(text_table(table).html(), LEGEND, ratios(table)))
    made = [("Results in metres", shown)]
    if (goals := maximised_table(table)) is not None:
        made.append((MAXIMISED, Markup(parts.table(goals.html(), _OF_SEARCHES, ""))))
    if targets:
        made.append(("Targets", Markup(parts.targets(verdict(targets), target_table(targets).html()))))
    made += [*sections, *([("Drives by outcome", Markup(parts.drives()))] if clips else [])]
    missing = sum(len(row.missing) for row in table.rows if row.domain == "surrogate")
    about = [
        table.name or "Results",
        f"{count(len(table.cells), 'cell')}{f', {missing} missing' if missing else ''}",
    ]
    return render(
        first,
        made,
        about=[*about, *sorted({cell.machine for cell in table.cells.values()})],
        warnings=[each for each in (not_driven(table), *notes) if each],
    )
