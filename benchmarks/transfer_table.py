"""Question: what does the transfer table show, and is it what issue 5 asks for? Rows from the published cells of a campaign.

It computes nothing anew: the cells in ``docs/results/<campaign>`` are what ``advnerf campaign run`` finished and ``advnerf campaign publish`` copied.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from advnerf_core.report.cells import CellResult
from advnerf_core.report.transfer import DOMAINS, TableRow, TransferTable
from advnerf_core.report.transfer_page import METHOD_NAMES, ran_into_something
from advnerf_core.report.transfer_targets import VICTIM, TableTarget, table_targets
from benchmarks.results import record_row
from nodes.campaign.config import load_campaign
from nodes.campaign.table import published_table

FOLDER, CAMPAIGN = Path("docs/results/paper"), Path("launch/paper.campaign.yaml")


def line_of(row: TableRow) -> str:
    """What a row of the ledger is called, e.g. ``#5 straight, gradient, surrogate``."""
    parts = [row.scenario, row.placement, METHOD_NAMES.get(row.method, row.method), row.domain]
    return "#5 " + ", ".join(filter(None, [*parts, "" if row.victim == VICTIM else f"{row.victim} victim"]))


def note_of(row: TableRow, cells: Sequence[CellResult] = ()) -> str:
    """What readers must know of a row."""
    spread = "" if row.std_m is None else f" +- {row.std_m:.2f}"
    parts = [
        f"seeds {', '.join(map(str, row.seeds))}: total CTE {row.mean_m or 0.0:.2f}{spread} m, off-track {row.off_track} of {row.drives}"
    ]
    if row.missing:
        parts.append(f"seeds {', '.join(map(str, row.missing))} are missing")
    machines = sorted({cell.machine for cell in cells})
    parts.append(f"run on {', '.join(machines)}")
    if row.ratio_interval is not None:
        parts.append(f"95 % {row.ratio_interval.low:.2f} to {row.ratio_interval.high:.2f}")
    if row.transfer is not None and row.method != "none":
        parts.append(f"transfer ratio {row.transfer:.2f}")
    if row.paper_ratio is not None:
        parts.append(f"paper {row.paper_ratio:.2f} x its deployed drive without attack")
    return "; ".join(parts)


def why_missed(target: TableTarget | None, row: TableRow, none: TableRow | None, cells: Sequence[CellResult]) -> str:
    """By how much a ratio misses its target, and what that is on the road; empty where it does not."""
    if target is None or target.met is not False or none is None or row.mean_m is None or none.mean_m is None:
        return ""
    text = f"; {target.verdict}"
    if (ticks := cells[0].extra.get("horizon") if cells else None) is not None:
        off_mm, clean_mm = (1000 * each / ticks for each in (row.mean_m, none.mean_m))
        text += f": {off_mm:.0f} mm off the path on average, {clean_mm:.0f} mm without attack; a base this small makes ratios of millimetres"
    return text


def how_far(cells: Sequence[CellResult]) -> str:
    """How far off live drives came, beside the distance that counts, and how many ended at an obstacle; empty for other cells."""
    far = [cell.extra for cell in cells if "max_abs_cte_m" in cell.extra]
    if not far:
        return ""
    ran = sum(ran_into_something(cell) for cell in cells)
    text = f"; at most {max(each['max_abs_cte_m'] for each in far):.2f} m off the path, off-track is beyond {far[0]['off_track_m']:.2f} m"
    return text + (f"; ran into an obstacle, which held it there, in {ran} of {len(cells)}" if ran else "")


def rows_of(table: TransferTable) -> list[tuple[TableRow, TableTarget | None]]:
    """Rows with drives, none left out as it is 1 by definition, with the target on their ratio where there is one."""
    targets = {(t.scenario, t.method, t.domain): t for t in table_targets(table) if t.what == "ratio to no attack"}
    return [
        (
            row,
            targets.get((row.scenario, row.method, row.domain)) if row.victim == VICTIM and not row.placement else None,
        )
        for domain in DOMAINS
        for row in table.rows
        if row.domain == domain and row.seeds and row.method != "none" and row.ratio is not None
    ]


def main() -> None:
    """Record the rows of the published table, and its other targets."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--campaign", type=Path, default=CAMPAIGN, help="which lines and seeds there should be")
    parser.add_argument("--command", default="advnerf campaign run launch/paper.campaign.yaml")
    parser.add_argument("--dry", action="store_true", help="print only")
    arguments = parser.parse_args()
    table = published_table(arguments.folder, load_campaign(arguments.campaign))

    def record(line: str, value: float, unit: str, target: str, met: bool | None, note: str) -> None:
        print(f"{line}: {value:.3g} {unit} (target {target or '-'}): {met}")
        if not arguments.dry:
            record_row(line, value, unit, target, met, arguments.command, note)

    for row, target in rows_of(table):
        record(
            line_of(row), row.ratio or 0.0, "x no attack", f"{target.target} x" if target else "",
            target.met if target else None, note_of(row, cells := table.cells_of(row))
            + why_missed(target, row, table.find(row.scenario, row.victim, "none", row.domain, row.placement), cells),
        )  # fmt: skip
    for target in table_targets(table):
        if target.what != "ratio to no attack" and target.value is not None:
            line = f"#5 {target.scenario}, {METHOD_NAMES[target.method]}, {target.domain}: {target.what}"
            row_of_target = table.find(target.scenario, VICTIM, target.method, target.domain)
            cells = table.cells_of(row_of_target) if row_of_target else []
            note = f"{target.seeds} seeds" + (how_far(cells) if "off the track" in target.what else "")
            record(line, target.value, "", target.target, target.met, note)


if __name__ == "__main__":
    main()
