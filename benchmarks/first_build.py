"""The cells of the first build in metres: ``python -m benchmarks.first_build`` writes docs/results/first_build.md.

They kept totals and no drives, were not registered, and were measured from the starts that they had searched from.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from advnerf_core.files import write_atomically
from advnerf_core.report.cells import CellResult, read_cells
from advnerf_core.report.conditions import CONTROLS, order_of, style_of
from advnerf_core.report.evidence.registration import FILE
from advnerf_core.report.evidence.words import DOMAIN_TITLES
from advnerf_core.report.transfer import DOMAINS, drives_in
from benchmarks.questions import LOST
from benchmarks.results import REPOSITORY

PUBLISHED = REPOSITORY / "docs" / "results"
PAGE = PUBLISHED / "first_build.md"
_HEAD = f"""# The first build, in metres

{LOST}

These cells were not registered. They kept the total |CTE| of each drive and not the drive itself,
and each search was measured from the starts that it had searched from. They have no intervals and
claim no test.

`python -m benchmarks.first_build` writes this page from the cells beside it.
"""
_NO_TICKS = "These cells did not keep the number of ticks, so their totals cannot be told per tick.\n"
_COLUMNS = "| scenario | victim | object shows | driven in | searches | excess [m per tick] | off track |\n|---|---|---|---|---|---|---|\n"


def main() -> None:
    write_atomically(PAGE, page_text())
    print(f"wrote {Path(PAGE).relative_to(REPOSITORY)}")


def page_text() -> str:
    """The page in Markdown, from the published cells of sets without a registration."""
    folders = sorted(
        folder for folder in PUBLISHED.iterdir() if folder.is_dir() and any(folder.glob("*_*.json"))
    )
    parts = [_HEAD]
    for folder in folders:
        if not (folder / FILE).exists():
            rows = "".join(_rows(read_cells(folder)))
            parts.append(f"\n## {folder.name}\n\n{_COLUMNS + rows if rows else _NO_TICKS}")
    return "".join(parts)


def _rows(cells: list[CellResult]) -> Iterator[str]:
    groups: dict[tuple[str, str, str, str], list[CellResult]] = {}
    for cell in cells:
        if cell.method not in CONTROLS and cell.extra.get("horizon"):
            groups.setdefault((cell.scenario, cell.placement, cell.victim, cell.method), []).append(cell)
    for key in sorted(groups, key=lambda key: (key[:3], order_of(key[3]))):
        for domain in DOMAINS:
            found = [
                (cell, drives) for cell in groups[key] if (drives := drives_in(cell, domain)) is not None
            ]
            if not found:
                continue
            excess = [
                np.subtract(drives.total_cte_m, drives.none_total_cte_m).mean() / cell.extra["horizon"]
                for cell, drives in found
            ]
            off = [each for _, drives in found for each in drives.off_track]
            place = " ".join(filter(None, key[:2]))
            yield (
                f"| {place} | {key[2]} | {style_of(key[3]).title} | {DOMAIN_TITLES[domain]} | {len(found)} | {np.mean(excess):.3f} "
                f"| {sum(off)} of {len(off)} |\n"
            )


if __name__ == "__main__":
    main()
