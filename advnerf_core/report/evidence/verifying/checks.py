"""All checks of one set, apart from digests and published numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from advnerf_core.report.cells import CellResult
from advnerf_core.report.evidence.registration import read_withdrawn
from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.evidence.verifying.besides import gate_problems, prediction_problems
from advnerf_core.report.evidence.verifying.drives import drive_problems
from advnerf_core.report.evidence.verifying.registered import build_problems, cell_problems, missing_cells
from advnerf_core.report.evidence.verifying.searches import search_problems
from advnerf_core.report.evidence.verifying.victims import declaration_problems, read_declared


def set_problems(
    folder: Path, evidence: Evidence, cells: Sequence[CellResult], under_way: bool = False
) -> Iterator[str]:
    """Problems of the cells of a set and of the files beside them; while it is under way, cells may be missing."""
    damaged, withdrawn = under_way, read_withdrawn(folder)
    missing = [] if under_way else missing_cells(evidence, cells, withdrawn)
    absent = (f"{name}: was registered, and is not there" for name in missing)
    for check in (absent, cell_problems(evidence, cells, withdrawn), drive_problems(evidence)):
        for problem in check:
            damaged = True
            yield problem
    yield from build_problems(evidence)
    yield from search_problems(evidence)
    yield from prediction_problems(folder, evidence)
    yield from gate_problems(folder, evidence)
    if not damaged:
        yield from declaration_problems(evidence, read_declared(folder))
