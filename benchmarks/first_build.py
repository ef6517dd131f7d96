"""The cells of the first build in metres: ``python -m benchmarks.first_build`` writes docs/results/first_build.md.

They kept totals and no drives, were not registered, and were measured from the starts that they had searched from.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from advnerf_core.files import write_atomically
from advnerf_core.report.cells import CellResult, read_cells
from advnerf_core.report.conditions import CONTROLS, order_of, style_of
from advnerf_core.report.evidence.registration import FILE
from advnerf_core.report.evidence.words import DOMAIN_TITLES
from advnerf_core.report.result_table import make_table
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
    seeds: dict[tuple[str, str, str, str], list[int]] = {}
    for cell in cells:
        if cell.method not in CONTROLS and cell.ticks:
            seeds.setdefault(cell.key, []).append(cell.seed)
    keys = sorted(seeds, key=lambda key: (key[:3], order_of(key[3])))
    for row in make_table({key: seeds[key] for key in keys}, cells).rows:
        if row.excess is not None:
            place = " ".join(filter(None, row.key[:2]))
            yield (
                f"| {place} | {row.victim} | {style_of(row.method).title} | {DOMAIN_TITLES[row.domain]} | {row.excess.searches} "
                f"| {row.excess.excess_m:.3f} | {row.off_track} of {row.drives} |\n"
            )


if __name__ == "__main__":
    main()
