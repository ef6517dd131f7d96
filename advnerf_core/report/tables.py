"""The tables of the report: computed once, shown in the terminal, in the page and in `results.json`."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import rich.box
import rich.table
from markupsafe import Markup
from rich.text import Text

from advnerf_core.report.conditions import NONE, order_of, style_of
from advnerf_core.report.data import DOMAINS, Domain, ReportData, Run


@dataclass(frozen=True)
class TransferRow:
    """One cell of the transfer table, over all seeds and start poses.

    Attributes:
        victim: Which policy drove.
        domain: Where it drove.
        condition: What the object showed.
        runs: Number of drives.
        total_cte_mean_m: Mean over the drives of the total CTE [m].
        total_cte_std_m: Its sample standard deviation [m]; None for one drive.
        ratio: Sum of the total CTE divided by that of no attack in the same domain, drive by drive from the same start.
        ratio_std: Sample standard deviation of the ratio over seeds; None for one seed.
        mean_abs_cte_m: Mean ``|CTE|`` over ticks and drives [m].
        off_track: Number of drives that left the track.
        time_to_leave_s: Mean time to leaving, of those that left [s].
    """

    victim: str
    domain: Domain
    condition: str
    runs: int
    total_cte_mean_m: float
    total_cte_std_m: float | None
    ratio: float | None
    ratio_std: float | None
    mean_abs_cte_m: float
    off_track: int
    time_to_leave_s: float | None

    def record(self) -> dict[str, Any]:
        """The row as JSON-ready values."""
        return asdict(self)


def transfer_rows(data: ReportData) -> tuple[TransferRow, ...]:
    """Rows of the transfer table in reading order; cells without a drive are left out."""
    rows = []
    for victim in data.victims:
        for domain in DOMAINS:
            clean = data.select(victim=victim, domain=domain, condition=NONE)
            met = {run.condition for run in data.select(victim=victim, domain=domain)}
            for condition in sorted(met, key=order_of):
                rows.append(
                    _transfer_row(data.select(victim=victim, domain=domain, condition=condition), clean)
                )
    return tuple(rows)


def find_row(
    rows: Sequence[TransferRow], domain: Domain, condition: str, victim: str = "hardened"
) -> TransferRow | None:
    """The row of one cell; None if nothing was driven there."""
    return next((r for r in rows if (r.domain, r.condition, r.victim) == (domain, condition, victim)), None)


def _transfer_row(runs: Sequence[Run], clean: Sequence[Run]) -> TransferRow:
    first = runs[0]
    totals = [r.total_cte_m for r in runs]
    left = [r.time_to_leave_s for r in runs if r.off_track and r.time_to_leave_s is not None]
    by_seed = [_ratio([r for r in runs if r.seed == seed], clean) for seed in sorted({r.seed for r in runs})]
    seed_ratios = [r for r in by_seed if r is not None]
    return TransferRow(
        victim=first.victim,
        domain=first.domain,
        condition=first.condition,
        runs=len(runs),
        total_cte_mean_m=statistics.fmean(totals),
        total_cte_std_m=statistics.stdev(totals) if len(totals) > 1 else None,
        ratio=_ratio(runs, clean),
        ratio_std=statistics.stdev(seed_ratios) if len(seed_ratios) > 1 else None,
        mean_abs_cte_m=statistics.fmean(r.mean_abs_cte_m for r in runs),
        off_track=sum(r.off_track for r in runs),
        time_to_leave_s=statistics.fmean(left) if left else None,
        # The paper's victim had never seen the object with other textures, but it is the one that both are compared with.
    )


def _ratio(runs: Sequence[Run], clean: Sequence[Run]) -> float | None:
    """Total CTE over that of no attack; a drive from a start without a clean drive is compared with the mean of all."""
    if not clean:
        return None
    everywhere = statistics.fmean(c.total_cte_m for c in clean)
    baseline = 0.0
    for run in runs:
        same_start = [c.total_cte_m for c in clean if c.start == run.start]
        baseline += statistics.fmean(same_start) if same_start else everywhere
    return sum(r.total_cte_m for r in runs) / baseline if baseline > 0 else None


def number(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A number for a reader; an en dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}{unit}"


def spread(mean: float | None, std: float | None, digits: int = 2) -> str:
    """Mean with its standard deviation, where there is one."""
    if mean is None:
        return "–"
    return number(mean, digits) if std is None else f"{mean:.{digits}f} ± {std:.{digits}f}"


@dataclass(frozen=True)
class Table:
    """A table of text that knows how to show itself.

    Attributes:
        title: Heading in the terminal.
        columns: Column headings.
        rows: Cells, one text per column.
        right: Which columns are numbers, aligned right.
        groups: Rows before which a new group starts.
        classes: One CSS class per row, or "" (page only).
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: tuple[bool, ...]
    groups: tuple[int, ...] = ()
    classes: tuple[str, ...] = ()

    def html(self) -> Markup:
        """The table as HTML; every cell is escaped."""
        head = Markup("").join(
            Markup('<th scope="col"{}>{}</th>').format(self._align(i), c) for i, c in enumerate(self.columns)
        )
        body = Markup("").join(self._html_row(i, row) for i, row in enumerate(self.rows))
        return Markup(
            '<div class="scroll"><table><thead><tr>{}</tr></thead><tbody>{}</tbody></table></div>'
        ).format(head, body)

    def _html_row(self, index: int, row: Sequence[str]) -> Markup:
        names = [self.classes[index]] if index < len(self.classes) and self.classes[index] else []
        names += ["group"] if index in self.groups else []
        cells = Markup("").join(
            Markup("<td{}>{}</td>").format(self._align(i), cell) for i, cell in enumerate(row)
        )
        return (
            Markup('<tr class="{}">{}</tr>').format(" ".join(names), cells)
            if names
            else Markup("<tr>{}</tr>").format(cells)
        )

    def _align(self, column: int) -> Markup:
        return Markup(' class="number"') if self.right[column] else Markup("")

    def markdown(self) -> str:
        """The table in Markdown, without its title; ends with a line break."""
        rule = "|" + "|".join("---:" if right else "---" for right in self.right) + "|"
        return "\n".join([_markdown_row(self.columns), rule, *map(_markdown_row, self.rows), ""])

    def rich(self) -> rich.table.Table:
        """The table for the terminal; `Text` keeps rich from reading units in brackets as markup."""
        table = rich.table.Table(title=self.title or None, box=rich.box.SIMPLE_HEAD, title_justify="left")
        for heading, right in zip(self.columns, self.right, strict=True):
            table.add_column(Text(heading), justify="right" if right else "left")
        for i, row in enumerate(self.rows):
            if i in self.groups and i > 0:
                table.add_section()
            table.add_row(*(Text(cell) for cell in row))
        return table


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def hop_table(data: ReportData) -> Table:
    """Latency per hop, the whole path last."""
    hops = () if data.latency is None else (*data.latency.hops, data.latency.overall)
    cells = tuple(
        (h.name, str(h.count), *(number(v, 1) for v in (h.p50_ms, h.p95_ms, h.p99_ms, h.max_ms)))
        for h in hops
    )
    columns = ("hop", "frames", "p50 [ms]", "p95 [ms]", "p99 [ms]", "max [ms]")
    return Table("Live latency", columns, cells, (False, *[True] * 5), (len(cells) - 1,))


def live_tries_table(data: ReportData) -> Table:
    """Tries of the live drives of each arm, with the reasons of those that did not count."""
    cells = tuple(
        (
            style_of(t.condition).title,
            t.victim,
            str(t.seed),
            "yes" if t.driven else "NOT DRIVEN LIVE",
            str(len(t.spoiled)),
            "; ".join(t.spoiled),
        )
        for t in data.live_tries
    )
    columns = ("arm", "policy", "seed", "driven live", "spoiled tries", "why they do not count")
    return Table("Live drives", columns, cells, (False, False, True, False, True, False))


def memory_table(data: ReportData) -> Table:
    """Peak memory against the horizon."""
    cells = tuple(
        (str(m.horizon_steps), number(m.adjoint_mib, 1), number(m.backprop_mib, 1)) for m in data.memory
    )
    return Table(
        "Peak memory above idle", ("T", "adjoint [MiB]", "back-propagation [MiB]"), cells, (True, True, True)
    )


def timing_table(data: ReportData) -> Table:
    """Wall time of the stages and their sum."""
    cells = [(t.name, number(t.wall_s, 1), "from cache" if t.cached else "") for t in data.timings]
    if cells:
        cells.append(("all stages", number(sum(t.wall_s for t in data.timings), 1), ""))
    return Table(
        "Stages", ("stage", "wall time [s]", ""), tuple(cells), (False, True, False), (len(cells) - 1,)
    )
