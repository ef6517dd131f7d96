"""Were the predictions of a registered set any good? ``python -m benchmarks.predictions SET [--past SET]...``.

Reads published cells and the predictions beside them (``advnerf predict``-ed before any deployed drive with the attack was looked at), and
scores every deployed drive: how many lie in the predicted 80 % bands, and the mean interval score against that of "as in the surrogate,
with the spread between surrogate and deployment that earlier sets had".
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.prediction_score import ScoredCell, score_cells
from advnerf_core.report.evidence.registration import read_registration
from advnerf_core.report.evidence.results import Evidence
from benchmarks.results import REPOSITORY, LedgerRow

PUBLISHED = REPOSITORY / "docs" / "results"
_HOLD = (0.65, 0.95)


def main() -> None:
    """Score and record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", help="name of a published set")
    parser.add_argument("--past", nargs="*", default=["room"], help="published sets that were known before")
    parser.add_argument(
        "--afterwards",
        action="store_true",
        help="those that were made after the drives, whose rows are no result",
    )
    options = parser.parse_args()
    for each in scored(options.set, options.past, options.afterwards):
        print(
            f"{each.name}: said {each.band[0]:.3f} to {each.band[1]:.3f}, was {np.mean(each.measured):.3f} half lanes per tick, "
            f"{each.held} of {len(each.measured)} drives held; score {each.score:.3f}, trivial {each.trivial_score:.3f}"
        )
    for row in ledger_rows(options.set, options.past, options.afterwards):
        print(f"{row.line}: {row.value} {row.unit}; {row.note}")
        row.record()


def scored(name: str, past: Sequence[str], afterwards: bool) -> list[ScoredCell]:
    """The scored predictions of a published set."""
    folder = PUBLISHED / name / ("predictions_afterwards" if afterwards else "predictions")
    found = score_cells(evidence_of(name), predictions_in(folder), [evidence_of(each) for each in past])
    if not found:
        raise SystemExit(f"no predictions of deployed cells in {folder}")
    return found


def ledger_rows(name: str, past: Sequence[str], afterwards: bool) -> list[LedgerRow]:
    """The rows of a published set."""
    command = f"python -m benchmarks.predictions {name}{' --afterwards' * afterwards} --past {' '.join(past)}"
    return rows_of(name, scored(name, past, afterwards), command, afterwards)


@cache
def evidence_of(name: str) -> Evidence:
    """A published set."""
    registration = read_registration(PUBLISHED / name)
    if registration is None:
        raise SystemExit(f"expected a registered set in {PUBLISHED / name}, got none")
    return Evidence(registration, read_cells(PUBLISHED / name))


def predictions_in(folder: Path) -> dict[str, dict[str, float]]:
    """Predictions by cell."""
    return {file.stem: read_json(file) for file in folder.glob("*.json")}


def rows_of(name: str, found: list[ScoredCell], command: str, afterwards: bool) -> list[LedgerRow]:
    """The two rows of scored predictions."""
    drives = sum(len(each.measured) for each in found)
    share = sum(each.held for each in found) / drives
    ours, trivial = (
        float(np.mean([getattr(each, which) for each in found])) for which in ("score", "trivial_score")
    )
    note = f"{len(found)} attacks, {drives} deployed drives of the set {name}"
    which = name
    held: bool | None = _HOLD[0] <= share <= _HOLD[1]
    better: bool | None = ours < trivial
    if afterwards:
        which, held, better = f"{name}, predicted afterwards", None, None
        note += "; the predictor reads no attacked drive, but these were made after them"
    scores = f"{note}; {ours:.3f} against {trivial:.3f} half lanes per tick"
    return [
        LedgerRow(f"deployed drives within their predicted 80 % bands, {which}", round(100 * share), "%", "65 to 95 %", held, command, note),
        LedgerRow(f"interval score of predicted excess against the surrogate's with the past's spread, {which}", ours / trivial, "x", "< 1", better, command, scores),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
