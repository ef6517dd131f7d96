"""The transfer table to look at: in the terminal, as CSV, Markdown and JSON, and as a page with the drives' clips."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)

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
from advnerf_core.report.palette import look_css
from advnerf_core.report.statistics import Interval
from advnerf_core.report.tables import Table, number, spread
from advnerf_core.report.transfer import TableRow, TransferTable
from advnerf_core.report.transfer_targets import TableTarget, table_targets

SCHEMA = "advnerf-transfer/1"
STRAYED_FROM = 1.5
_LEAD = "Total cross-track error of every scenario, victim and method, in the learned scene and where it is deployed."
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
_MISSING = "missing"
LEGEND = (
    "Total CTE [m]: mean over seeds ± standard deviation over seeds. × no attack: ratio of sums to the same starts without attack in the same domain. "
    "Transfer: deployed ratio over surrogate ratio, from the same starts. 95 %: percentile bootstrap over seeds; of three seeds that is their range. "
    "Seeds, and victims, may be of several builds of scene and policies: each cell's JSON has their digests, as far as they were kept. "
    "Paper: its totals have units of their own per scenario, and its ratios are all to its deployed drive without attack."
)


@dataclass(frozen=True)
class ShownClip:
    """A clip of a cell.

    Attributes:
        cell: Whose drive it is.
        outcome: One of `OUTCOMES`.
        file: Where it is, relative to the page.
    """

    cell: CellResult
    outcome: str
    file: str

    @property
    def caption(self) -> str:
        """What is seen."""
        drives = self.cell.deployed or self.cell.surrogate
        return (
            f"total CTE {sum(drives.total_cte_m):.2f} m, without attack {sum(drives.none_total_cte_m):.2f} m"
        )


def outcome_of(cell: CellResult) -> str:
    """How the deployed drives of a cell ended; those in the surrogate where it was not deployed."""
    drives = cell.deployed or cell.surrogate
    if any(drives.off_track):
        return LEFT
    if ran_into_something(cell):
        return RAN_INTO
    strayed = sum(drives.total_cte_m) >= STRAYED_FROM * sum(drives.none_total_cte_m)
    return STRAYED if strayed and cell.method != NONE else HELD


def ran_into_something(cell: CellResult) -> bool:
    """Whether a deployed drive of a cell was held by an obstacle (``blocked_tick`` of its extra, one for each drive)."""
    return cell.deployed is not None and any(tick is not None for tick in cell.extra.get("blocked_tick", []))


def text_table(table: TransferTable) -> Table:
    """All lines as text."""
    columns = (
        "scenario",
        "victim",
        "object shows",
        "domain",
        "seeds",
        "total CTE",
        "× no attack",
        "95 %",
        "transfer",
        "95 %",
        "off-track",
        "paper",
        "paper ×",
    )
    cells, groups, classes = [], [], []
    for index, row in enumerate(table.rows):
        last = table.rows[index - 1] if index else None
        new_scenario = last is None or (row.scenario, row.placement) != (last.scenario, last.placement)
        new_victim = new_scenario or (last is not None and row.victim != last.victim)
        if new_victim:
            groups.append(index)
        where = f"{row.scenario}, {row.placement}" if row.placement else row.scenario
        name = style_of(row.method).title if row.domain == "surrogate" else ""
        cells.append((where if new_scenario else "", row.victim if new_victim else "", name, *_numbers(row)))
        classes.append(row.method if row.seeds else "unmeasured")
    right = (False, False, False, False, *[True] * 9)
    return Table("Transfer", columns, tuple(cells), right, tuple(groups), tuple(classes))


def _numbers(row: TableRow) -> tuple[str, ...]:
    seeds = f"{len(row.seeds)} of {len(row.seeds) + len(row.missing)}"
    if not row.seeds:
        return (
            row.domain,
            seeds,
            _MISSING,
            "",
            "",
            "",
            "",
            "",
            spread(row.paper_m, row.paper_std_m, 0),
            number(row.paper_ratio),
        )
    return (
        row.domain,
        seeds,
        spread(row.mean_m, row.std_m),
        number(row.ratio),
        _interval(row.ratio_interval),
        "" if row.domain == "surrogate" or row.method == NONE else number(row.transfer),
        "" if row.method == NONE else _interval(row.transfer_interval),
        f"{row.off_track} of {row.drives}",
        spread(row.paper_m, row.paper_std_m, 0),
        number(row.paper_ratio),
    )


def _interval(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval.low:.2f} – {interval.high:.2f}"


def target_table(targets: Sequence[TableTarget]) -> Table:
    """The targets as text."""
    cells = tuple(
        (
            t.scenario,
            style_of(t.method).title,
            t.domain,
            t.what,
            t.target,
            number(t.value),
            str(t.seeds),
            t.verdict,
        )
        for t in targets
    )
    classes = tuple({True: "met", False: "missed", None: "unmeasured"}[t.met] for t in targets)
    columns = ("scenario", "object shows", "domain", "what", "target", "measured", "seeds", "verdict")
    return Table(
        "Targets", columns, cells, (False, False, False, False, True, True, True, False), classes=classes
    )


def as_json(table: TransferTable) -> dict[str, Any]:
    """Lines, targets and cells as JSON-ready values."""
    return {
        "schema": SCHEMA,
        "name": table.name,
        "rows": [row.record() for row in table.rows],
        "targets": [target.record() for target in table_targets(table)],
        "cells": {name: cell.model_dump(mode="json") for name, cell in table.cells.items()},
    }


def as_csv(table: TransferTable) -> str:
    """The lines, one column per number; empty where there is none."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    plain = [name for name in TableRow.__dataclass_fields__ if not name.endswith("_interval")]
    ends = ("ratio_low", "ratio_high", "transfer_low", "transfer_high")
    writer.writerow([*plain, *ends])
    for row in table.rows:
        values = [getattr(row, name) for name in plain]
        intervals = [row.ratio_interval, row.transfer_interval]
        bounds = [value for each in intervals for value in ((each.low, each.high) if each else ("", ""))]
        writer.writerow([_field(value) for value in (*values, *bounds)])
    return stream.getvalue()


def _field(value: Any) -> Any:
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return "" if value is None else value


def as_markdown(table: TransferTable) -> str:
    """Lines and targets as a Markdown page."""
    parts = (
        f"# {table.name or 'Transfer table'}\n",
        f"{LEGEND}\n",
        text_table(table).markdown(),
        "## Targets\n",
        target_table(table_targets(table)).markdown(),
    )
    return "\n".join(parts)


def gather_clips(table: TransferTable, cells_folder: Path, page_folder: Path) -> list[ShownClip]:
    """Put the cells' clips beside the page, in one folder per outcome; as links of the same file where the disk has them.

    Args:
        table: Whose cells.
        cells_folder: What the cells' clip names are relative to.
        page_folder: Folder of the page; older clips in its ``videos`` go.
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


def _targets_html(table: TransferTable) -> Markup:
    """The targets of a table with their caption; empty where it has none."""
    found = table_targets(table)
    if not found:
        return Markup("")
    caption = "Held against the hardened victim, for whom random textures are a fair baseline; places against the retrained one."
    return Markup('<p class="caption">{}</p><div class="verdicts">{}</div>').format(
        caption, target_table(found).html()
    )


def render_transfer_page(
    table: TransferTable,
    clips: Sequence[ShownClip] = (),
    sections: Sequence[tuple[str, Markup]] = (),
    lead: Sequence[str | Markup] = (),
    targets: Markup | None = None,
) -> str:
    """The page as HTML text; it loads nothing but the clips beside it.

    Args:
        table: The table.
        clips: Clips beside the page.
        sections: Further parts: heading and HTML.
        lead: Paragraphs, or HTML, before the table; none: what such a table is.
        targets: Instead of those of the table.
    """
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    resources = files("advnerf_core.report")
    template = environment.from_string(resources.joinpath("page.html").read_text(encoding="utf-8"))
    groups = [(name, _EXPLAINED[name], [clip for clip in clips if clip.outcome == name]) for name in OUTCOMES]
    return template.render(
        name=table.name or "Transfer table",
        legend=LEGEND,
        style=Markup(resources.joinpath("page.css").read_text(encoding="utf-8")),
        look=Markup(look_css()),
        table=text_table(table).html(),
        targets=targets or _targets_html(table),
        lead=lead or (_LEAD,),
        missing=sum(len(row.missing) for row in table.rows if row.domain == "surrogate"),
        cells=len(table.cells),
        machines=sorted({cell.machine for cell in table.cells.values()}),
        clips=clips,
        groups=groups,
        sections=sections,
        style_of=style_of,
    )
