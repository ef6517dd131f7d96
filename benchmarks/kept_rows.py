"""Rows of the ledger, computed again from what is kept with the code: published cells, predictions, verdicts and summaries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from advnerf_core.report.evidence.verifying.numbers import same
from benchmarks import gap, paper_table, predictions, retraining, transfer_correlation, victim_panel
from benchmarks.kept_commands import kept_by
from benchmarks.results import REPOSITORY, LedgerRow

PUBLISHED = REPOSITORY / "docs" / "results"
_COMPARED = ("value", "unit", "target", "met", "note")


_AGAIN: dict[str, Callable[..., list[LedgerRow]]] = {
    "retraining": retraining.ledger_rows,
    "gap": gap.ledger_rows,
    "predictions": predictions.ledger_rows,
    "paper": paper_table.ledger_rows,
    "correlation": transfer_correlation.ledger_rows,
    "panel": victim_panel.ledger_rows,
}


def computed_again(commands: Sequence[str]) -> list[LedgerRow]:
    """All rows that the kept data of these commands gives; rows of what is not kept are left out."""
    wanted = dict.fromkeys(found for command in commands if (found := kept_by(command)) is not None)
    return [row for name, arguments in wanted for row in _AGAIN[name](*arguments)]


def row_problems(rows: Sequence[Mapping[str, Any]], found_again: Sequence[LedgerRow]) -> Iterator[str]:
    """Which rows of the ledger are not what the kept data gives, and which it gives and the ledger has not.

    Args:
        rows: Of the ledger.
        found_again: By `computed_again`, of their commands.
    """
    again = {row.line: row for row in found_again}
    kept = {row["line"]: row for row in rows if kept_by(row["command"]) is not None}
    for line in sorted(again.keys() | kept.keys()):
        if line not in kept:
            yield f"{line!r}: the kept data gives this row, and the ledger does not have it"
        elif line not in again:
            yield f"{line!r}: the ledger has this row, and the kept data does not give it"
        else:
            found = vars(again[line])
            for key in _COMPARED:
                if not same(kept[line][key], found[key]):
                    yield f"{line!r}, {key}: recorded {kept[line][key]!r}, computed {found[key]!r}"


def counts(rows: Sequence[Mapping[str, Any]]) -> Mapping[bool, int]:
    """How many rows can be computed again (True), and how many cannot."""
    found: defaultdict[bool, int] = defaultdict(int)
    for row in rows:
        found[kept_by(row["command"]) is not None] += 1
    return found
