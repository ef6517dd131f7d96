"""The published numbers of a set of cells, in metres, computed from the published drives alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.driving.metrics import DriveMetrics, metrics_of_drives
from advnerf_core.report.cells import CellResult, read_cells
from advnerf_core.report.conditions import CONTROLS, NONE
from advnerf_core.report.evidence.anytime import AnytimeTest, anytime_test
from advnerf_core.report.evidence.exact import McNemar, holm, mcnemar_per_search, permutation_test
from advnerf_core.report.evidence.intervals import ClusteredInterval, difference_interval
from advnerf_core.report.evidence.registration import (
    PrimaryTest,
    RegisteredScenario,
    Registration,
    require_registration,
)
from advnerf_core.report.evidence.rows import CellDrives, Key, Outcome, Row, make_row
from advnerf_core.report.reference import DOMAINS, Domain

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SearchMeans:
    """Effect of one search, mean over its starts.

    Attributes:
        surrogate_m: Excess |CTE| per tick in the surrogate [m].
        deployed_m: The same deployed [m].
        shift_m: Signed CTE minus the one without attack, per tick in the surrogate [m]; positive is to the left.
    """

    surrogate_m: float
    deployed_m: float
    shift_m: float


@dataclass(frozen=True)
class TestResult:
    """Result of a primary test.

    Attributes:
        test: The registered test.
        baseline: The baseline that is strongest in the surrogate.
        difference_m: Mean excess of the method minus the baseline's, deployed [m].
        low_m: Lower end of its interval over new searches of both and new starts [m]; None with too few.
        high_m: Upper end [m].
        p: Exact p of the permutation test; None if no test is claimed.
        p_holm: p adjusted for all primary tests.
        reason: Reason for a missing p.
        difference_surrogate_m: The same difference in the surrogate [m].
        p_surrogate: p of the same test there; a description, not adjusted, and too large if there are several baselines, since
            the strongest one is chosen from these drives.
        searches: Means of each search of both, by method.
        anytime: The test that could have stopped earlier, deployed; a description, not adjusted.
        mcnemar: Off-track against the baseline, search by search.
    """

    test: PrimaryTest
    baseline: str
    difference_m: float
    low_m: float | None
    high_m: float | None
    p: float | None
    p_holm: float | None
    reason: str
    difference_surrogate_m: float
    p_surrogate: float | None
    searches: dict[str, list[SearchMeans]]
    anytime: AnytimeTest
    mcnemar: tuple[McNemar, ...] = ()


class Evidence(CellDrives):
    """Outcomes of all drives of a registered set.

    Cells without published drives, not driven live, or of an unregistered scenario, are left out; ``all_cells`` has them too.
    """

    def __init__(self, registration: Registration, cells: Sequence[CellResult]) -> None:
        super().__init__(
            cell
            for cell in cells
            if cell.kept and not cell.not_driven_live and cell.scenario in registration.scenarios
        )
        self.all_cells = tuple(cells)
        self.registration, self.level = registration, registration.level
        self._named, self._digest = {cell.name for cell in registration.cells}, registration.digest
        self._paths = {name: each.reference_path() for name, each in registration.scenarios.items()}
        self._metrics: dict[tuple[str, Domain], list[DriveMetrics]] = {}

    def scenario_of(self, cell: CellResult) -> RegisteredScenario:
        """The registered scenario of a cell."""
        return self.registration.scenarios[cell.scenario]

    def is_registered(self, cell: CellResult) -> bool:
        """Whether a cell was registered, and run under this registration."""
        return cell.name in self._named and cell.registration == self._digest

    def metrics(self, cell: CellResult, domain: Domain) -> list[DriveMetrics]:
        """Metrics of the drives of a cell, computed from their published poses."""
        key = cell.name, domain
        if key not in self._metrics:
            path, horizon = (
                self._paths[cell.scenario],
                self.scenario_of(cell).horizon,
            )
            drives = cell.kept.get(domain, ())
            stopped = [drive.driven_ticks for drive in drives]
            self._metrics[key] = metrics_of_drives(
                path, [drive.poses() for drive in drives], horizon, stopped
            )
        return self._metrics[key]

    def has(self, cell: CellResult, domain: Domain) -> bool:
        """Whether drives of a cell are published."""
        return bool(cell.kept.get(domain))

    def share_starts(self, cells: Sequence[CellResult], domain: Domain) -> bool:
        """Registered searches are measured from the same starts."""
        return True

    def mean_ctes_m(self, cell: CellResult, domain: Domain) -> list[float]:
        """Mean |CTE| of each drive of a cell [m]."""
        return [metrics.mean_cte_m for metrics in self.metrics(cell, domain)]

    def outcomes(self, cell: CellResult, domain: Domain, control: str = NONE) -> list[Outcome]:
        """Outcomes of the drives of a cell, each against the control's drive from the same start; empty without such drives."""
        clean, horizon = self.without(cell, control), self.scenario_of(cell).horizon
        if clean is None:
            return []
        pairs = zip(
            self.metrics(cell, domain),
            self.metrics(clean, domain),
            cell.kept.get(domain, ()),
            strict=False,
        )
        return [Outcome.of(attacked, none, horizon, drive.obstacle) for attacked, none, drive in pairs]


def read_evidence(folder: Path) -> Evidence:
    """The evidence of a set in its folder.

    Raises:
        SetError: The folder has no registration, or it is damaged.
        CellError: A cell is damaged.
    """
    return Evidence(require_registration(folder), read_cells(folder))


def rows(evidence: Evidence) -> list[Row]:
    """All rows, in the order of the registration; unregistered ones come last."""
    keys: dict[Key, None] = {}
    for cell in evidence.registration.cells:
        keys[cell.scenario, cell.victim, cell.method] = None
    keys |= dict.fromkeys(cell.key for cell in evidence.cells.values())
    made = [make_row(evidence, key, domain) for key in keys for domain in DOMAINS]
    return sorted((row for row in made if row is not None), key=lambda row: not row.registered)


def primary_tests(evidence: Evidence) -> list[TestResult]:
    """The registered tests, adjusted by Holm over all registered ones: one that cannot be made counts as p = 1."""
    found = [test for each in evidence.registration.primary if (test := _test(evidence, each)) is not None]
    p_values = [test.p for test in found if test.p is not None]
    absent = [1.0] * (len(evidence.registration.primary) - len(found))
    # Too few searches for any test: the intervals remain.
    adjusted = iter(holm([*p_values, *absent]) if p_values else ())
    return [test if test.p is None else replace(test, p_holm=next(adjusted)) for test in found]


def as_data(evidence: Evidence) -> dict[str, Any]:
    """All published numbers as JSON data."""
    through = {str(cell.extra.get("deployed_through", "simulation")) for cell in evidence.cells.values()}
    return {
        "deployed_through": sorted(through),
        "searches": search_list(evidence),
        "rows": [vars(row) for row in rows(evidence)],
        "primary": [
            {**asdict(test), "test": test.test.model_dump(mode="json", exclude={"placement"})}
            for test in primary_tests(evidence)
        ],
    }


def search_list(evidence: Evidence) -> list[dict[str, Any]]:
    """The searches of a set, each once: several conditions, and other sets, may have driven the result of one search."""
    found = {
        (cell.victim, cell.method, cell.seed, cell.attack_id or "")
        for cell in evidence.cells.values()
        if cell.method not in CONTROLS
    }
    keys = ("victim", "method", "seed", "attack_id")
    return [dict(zip(keys, each, strict=True)) for each in sorted(found)]


def _test(evidence: Evidence, test: PrimaryTest) -> TestResult | None:
    """A test whose cells all exist; else None."""
    by_method = {
        method: evidence.searches((test.scenario, test.victim, method))
        for method in (test.method, *test.against)
    }
    if not all(cells and all(evidence.is_registered(cell) for cell in cells) for cells in by_method.values()):
        return None

    def means(method: str, domain: Domain) -> Floats:
        return np.array([mean_excess_m(evidence, cell, domain) for cell in by_method[method]])

    baseline = max(test.against, key=lambda method: float(means(method, "surrogate").mean()))
    two = (test.method, baseline)
    (searched, theirs), (deployed, against) = ([means(name, domain) for name in two] for domain in DOMAINS)
    found, there = permutation_test(deployed, against), permutation_test(searched, theirs)
    interval = _difference(evidence, by_method[test.method], by_method[baseline])
    off = [_off_track(evidence, by_method[name]) for name in two]
    return TestResult(
        test,
        baseline,
        difference_m=found.difference,
        low_m=interval.low if interval else None,
        high_m=interval.high if interval else None,
        p=found.p,
        p_holm=None,
        reason=found.reason,
        difference_surrogate_m=there.difference,
        p_surrogate=there.p,
        searches={name: [_search_means(evidence, cell) for cell in by_method[name]] for name in two},
        anytime=anytime_test(deployed, against, evidence.registration.alpha),
        mcnemar=mcnemar_per_search(off[0], off[1]) if len(off[0]) == len(off[1]) else (),
    )


def _difference(
    evidence: Evidence, method: Sequence[CellResult], baseline: Sequence[CellResult]
) -> ClusteredInterval | None:
    """Interval of the difference in deployed excess: searches of two methods, from the same starts."""
    one, other = ([evidence.excesses_m(cell, "deployed") for cell in cells] for cells in (method, baseline))
    if len({len(each) for each in (*one, *other)}) != 1:
        return None
    return difference_interval(np.array(one), np.array(other), evidence.registration.level)


def _search_means(evidence: Evidence, cell: CellResult) -> SearchMeans:
    clean = evidence.without(cell)
    assert clean is not None, "without it there is no outcome"
    drives = zip(evidence.metrics(cell, "surrogate"), evidence.metrics(clean, "surrogate"), strict=False)
    shifts = [float(np.mean(attacked.ctes_m) - np.mean(none.ctes_m)) for attacked, none in drives]
    excess = [mean_excess_m(evidence, cell, domain) for domain in DOMAINS]
    return SearchMeans(excess[0], excess[1], float(np.mean(shifts)))


def mean_excess_m(evidence: Evidence, cell: CellResult, domain: Domain) -> float:
    """Mean excess |CTE| per tick of a cell's drives [m]; the cell must have some in this domain."""
    return float(np.mean(evidence.excesses_m(cell, domain)))


def _off_track(evidence: Evidence, cells: Sequence[CellResult]) -> list[list[bool]]:
    return [[outcome.off_track for outcome in evidence.outcomes(cell, "deployed")] for cell in cells]
