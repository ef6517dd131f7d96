"""How well is deployed excess predicted? ``python -m benchmarks.predictions``.

Each published set is predicted from the sets before it alone: registered earlier, and driven before this one's first cell. The predictor
(`transfer_factor.belief`) and its rival, the surrogate's excess times the ratios that drives of the earlier sets had, read the drives in
the surrogate; both are scored by the deployed drives. Predictions that were registered before the drives are scored as what they were, against
the same rival. A set is one observation of its factor, so that binomial intervals over searches or drives are too narrow.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.evidence.verifying.layout import complete_sets
from advnerf_core.report.predictions import (
    LEVEL,
    Score,
    score_bands,
)
from benchmarks.results import REPOSITORY, LedgerRow
from benchmarks.transfer_factor import (
    Transfer,
    belief,
    binomial_interval,
    earlier_than,
    registered_bands,
    rival_bands,
    transfer_of,
)

PUBLISHED = REPOSITORY / "docs" / "results"
COMMAND = "python -m benchmarks.predictions"
_HOLD = (0.65, 0.95)
_ENDS = np.array([0.5 * (1.0 - LEVEL), 0.5 * (1.0 + LEVEL)])
_AFTER = (
    "; the predictor was written after all these sets were driven, and reads only what was known before each"
)


@dataclass(frozen=True)
class Predicted:
    """One set, predicted from the sets before it.

    Attributes:
        found: Its drives.
        band: 80 % band of its factor.
        ours: Score of the predictor.
        rival: Score of the rival.
        same_searches: Earlier sets that drove the same searches elsewhere.
    """

    found: Transfer
    band: tuple[float, float]
    ours: Score
    rival: Score
    same_searches: tuple[str, ...]

    def holds(self, factor: float) -> bool:
        """Whether a factor is within the band."""
        return self.band[0] <= factor <= self.band[1]


def main() -> None:
    """Score and record."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for row in ledger_rows():
        row.record()
        print(f"{row.line}: {row.value} {row.unit}; {row.note}")


def ledger_rows() -> list[LedgerRow]:
    """All rows, from the published sets."""
    sets = [evidence_of(name) for name in complete_sets(PUBLISHED)]
    sets = sorted((each for each in sets if each.cells), key=lambda each: each.registration.date)
    rows: list[LedgerRow] = []
    for baseline in (False, True):
        rows += forward_rows([made for each in sets if (made := forward(each, sets, baseline))], baseline)
    for each in sets:
        for folder in ("predictions", "predictions_afterwards"):
            rows += registered_rows(each, sets, PUBLISHED / each.registration.name / folder)
    return rows


@cache
def evidence_of(name: str) -> Evidence:
    """A registered set, read once: its metrics are computed once for the rows of all that ask for it."""
    return read_evidence(PUBLISHED / name)


def forward(evidence: Evidence, sets: Sequence[Evidence], baseline: bool) -> Predicted | None:
    """Predict a set from those before it; None if there is none, or nothing was driven."""
    earlier, found = before(evidence, sets, baseline), transfer_of(evidence, baseline)
    if not earlier or found is None:
        return None
    known = belief(earlier)
    low, high = known.factor_quantiles(_ENDS)
    bands = (
        known.bands(found.surrogate, found.scale, LEVEL),
        rival_bands(earlier, found.surrogate, LEVEL),
    )
    ours, rival = (score_bands(each, found.deployed) for each in bands)
    same = tuple(each.name for each in earlier if np.array_equal(each.surrogate, found.surrogate))
    return Predicted(found, (float(low), float(high)), ours, rival, same)


def before(evidence: Evidence, sets: Sequence[Evidence], baseline: bool) -> list[Transfer]:
    """What was driven in the sets before one."""
    made = [transfer_of(each, baseline) for each in earlier_than(evidence, sets)]
    return [each for each in made if each is not None]


def forward_rows(found: Sequence[Predicted], baseline: bool) -> list[LedgerRow]:
    """The rows over all sets, of the attacks or of the random families."""
    which = "random textures" if baseline else "attacks"
    searches = [(each, factor) for each in found for factor in each.found.factors]
    inside = sum(each.holds(each.found.factor) for each in found)
    sets = "; ".join(
        f"{each.found.name} {each.found.factor:.2f} in {each.band[0]:.2f} to {each.band[1]:.2f}"
        + (f" (the searches of {' and '.join(each.same_searches)})" if each.same_searches else "")
        for each in found
    )
    first = counted(f"factor of deployed excess, {which}: sets within the 80 % band from earlier sets", inside, len(found), sets + _AFTER)  # fmt: skip
    second = counted(
        f"factor of deployed excess, {which}: searches within the 80 % band of their set",
        sum(each.holds(factor) for each, factor in searches),
        len(searches),
        "searches of a set share its factor, so that this interval is too narrow",
    )
    return [first, second, *drive_rows(which, found, baseline)]


def drive_rows(which: str, found: Sequence[Predicted], baseline: bool) -> list[LedgerRow]:
    """Coverage of drives, and the interval score against the rival's."""
    held, theirs, drives = (
        sum(getattr(score, name) for score in scores)
        for scores, name in (
            ([each.ours for each in found], "held"),
            ([each.rival for each in found], "held"),
            ([each.ours for each in found], "drives"),
        )
    )
    by_set = ", ".join(f"{100 * each.ours.held / each.ours.drives:.0f}" for each in found)
    note = (
        f"{held} of {drives} drives of {len(found)} sets, by set {by_set} %; Clopper-Pearson {_interval(held, drives)} if drives were independent, "
        f"which they are not; the rival's bands hold {100 * theirs / drives:.0f} %"
    )
    good = None if baseline else _HOLD[0] <= held / drives <= _HOLD[1]
    coverage = LedgerRow(f"deployed drives within 80 % bands predicted from earlier sets, {which}", round(100 * held / drives), "%", "" if baseline else "65 to 95 %", good, COMMAND, note)  # fmt: skip
    ours, rival = (float(np.mean([score.score for score in scores])) for scores in zip(*((each.ours, each.rival) for each in found), strict=True))  # fmt: skip
    worse = sum(each.ours.score > each.rival.score for each in found)
    note = f"mean over {len(found)} sets, each under its last condition; {ours:.3f} against {rival:.3f} half lanes per tick; the rival is better in {worse} of them{_AFTER}"
    return [coverage, LedgerRow(f"interval score predicted from earlier sets against their ratios x surrogate, {which}", ours / rival, "x", "" if baseline else "<= 1", None if baseline else ours <= rival, COMMAND, note)]  # fmt: skip


def registered_rows(evidence: Evidence, sets: Sequence[Evidence], folder: Path) -> list[LedgerRow]:
    """Score predictions that were written before the deployed drives, or afterwards, against the rival; none without such files."""
    found, earlier = transfer_of(evidence), before(evidence, sets, False)
    said = {file.stem: read_json(file) for file in folder.glob("*.json")}
    if found is None or not said:
        return []
    bands = registered_bands(found, said, evidence.scenario_of(evidence.cells[found.cells[0]]).off_track_m)
    if bands is None:
        raise SystemExit(f"expected a prediction of each of {', '.join(found.cells)} in {folder}")
    ours = score_bands(bands, found.deployed)
    rival = score_bands(rival_bands(earlier, found.surrogate, LEVEL), found.deployed)
    afterwards, name, share = folder.name.endswith("afterwards"), found.name, ours.held / ours.drives
    which = f"{name}, predicted afterwards" if afterwards else name
    note = f"{len(found.cells)} attacks, {ours.drives} deployed drives of the set {name}, one observation of its factor"
    note += "; the predictor reads no attacked drive, but these were made after them" if afterwards else ""
    coverage = LedgerRow(f"deployed drives within their predicted 80 % bands, {which}", round(100 * share), "%", "65 to 95 %", None if afterwards else _HOLD[0] <= share <= _HOLD[1], COMMAND, note)  # fmt: skip
    return [coverage, LedgerRow(f"interval score of predicted excess against ratios of earlier sets x surrogate, {which}", ours.score / rival.score, "x", "< 1", None if afterwards else ours.score < rival.score, COMMAND, f"{note}; {ours.score:.3f} against {rival.score:.3f} half lanes per tick")]  # fmt: skip


def counted(line: str, held: int, count: int, note: str) -> LedgerRow:
    """A share with its binomial interval."""
    return LedgerRow(line, f"{held} of {count}", "", "", None, COMMAND, f"Clopper-Pearson 95 % interval {_interval(held, count)}; {note}")  # fmt: skip


def _interval(held: int, count: int) -> str:
    low, high = binomial_interval(held, count)
    return f"{100 * low:.0f} to {100 * high:.0f} %"


if __name__ == "__main__":
    main()
