"""What the benchmarks know of the published results, for ``advnerf verify``: ``python -m benchmarks.published_check``.

Computes the rows of the ledger again where what they were measured from is kept, and the verdicts of the fidelity gate; holds every
verdict of a row against its target, the pages against their rows, and the numbers of hand-written pages against rows and sets. Prints
one JSON object, which `nodes.cli.verify` reads.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.scene.fidelity import reasons_against
from advnerf_core.scene.gate_limits import GateLimits
from benchmarks.kept_rows import computed_again, counts, row_problems
from benchmarks.page_numbers import count_numbers
from benchmarks.results import PAGE, REPOSITORY, read_rows, write_pages
from nodes.experiment.run.admission import gate_file, gate_key
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.run import load_experiment

PUBLISHED = REPOSITORY / "docs" / "results"
_TARGET = re.compile(r"(>=|<=|>|<) ?(\d[\d,]*(?:\.\d+)?)(?![\d^])")


def main() -> None:
    """Check and print."""
    rows = read_rows()
    kept, numbers = counts(rows), count_numbers(REPOSITORY / "docs", rows)
    again = computed_again([row["command"] for row in rows])
    problems = [
        *row_problems(rows, again),
        *target_problems(rows),
        *gate_problems(),
        *row_page_problems(rows, PAGE),
    ]
    found = {"rows": kept[True], "not_kept": kept[False], "numbers": vars(numbers)}
    print(json.dumps({**found, "problems": [*problems, *numbers.problems]}))


def target_problems(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Rows that say they met a target whose first limit their value breaks, or missed one that has no other."""
    for row in rows:
        limit, value = _TARGET.match(row["target"]), row["value"]
        if row["met"] is None or limit is None or not isinstance(value, int | float):
            continue
        bound = float(limit[2].replace(",", ""))
        holds = {">=": value >= bound, "<=": value <= bound, ">": value > bound, "<": value < bound}[limit[1]]
        alone = not re.search(r"[,;(]| and ", row["target"])
        if row["met"] and not holds:
            yield f"{row['line']!r}: says that {value:g} met {row['target']}"
        elif alone and holds and not row["met"]:
            yield f"{row['line']!r}: says that {value:g} missed {row['target']}"


def row_page_problems(rows: list[dict[str, Any]], page: Path) -> Iterator[str]:
    """Pages that are not those of the rows, beside the index ``page`` too."""
    with TemporaryDirectory() as work:
        made = Path(work) / page.name
        try:
            write_pages(rows, made, page.parent / "results")
        except AdvnerfError as error:
            yield f"{page}: cannot be written again: {error}"
            return
        for file in [made, *sorted((made.parent / "results").iterdir())]:
            published = page.parent / file.relative_to(made.parent)
            if not published.exists() or published.read_text("utf-8") != file.read_text("utf-8"):
                yield f"{published}: is not the page of the rows; python -m benchmarks.results writes it"


def gate_problems() -> Iterator[str]:
    """Verdicts of the fidelity gate that do not follow from their numbers and the limits of the experiment."""
    for file in sorted((REPOSITORY / "launch").glob("*.experiment.yaml")):
        folder = PUBLISHED / file.name.split(".")[0]
        if (folder / "gate").exists():
            yield from _verdicts(load_experiment(file, None, [], None), folder)


def _verdicts(experiment: Experiment, folder: Path) -> Iterator[str]:
    cells = {gate_key(cell): cell for cell in experiment.cells}
    for key, cell in sorted(cells.items()):
        limits = experiment.config_of(cell).gate
        for drive, of in ((False, "held-out views"), (True, "drive without attack")):
            file = gate_file(folder, key, drive)
            if not isinstance(limits, GateLimits) or not file.exists():
                continue
            said = read_json(file)
            reasons = list(reasons_against(said["numbers"], limits, of))
            if reasons != said["reasons"] or said["passed"] is bool(reasons):
                yield f"{file.relative_to(REPOSITORY)}: expected reasons {reasons} of its numbers, got {said['reasons']}, passed: {said['passed']}"


if __name__ == "__main__":
    main()
