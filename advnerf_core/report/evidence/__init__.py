"""The statistics of published results: outcomes in metres, clustered intervals, and registered tests.

Intervals describe every result. Tests are few and registered beforehand, and `holm` adjusts exactly those.
"No effect" is claimed by `equivalence` alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from advnerf_core.lazy import lazy_names

__all__ = [
    "FEW_SEARCHES",
    "ClusteredInterval",
    "Equivalence",
    "McNemar",
    "Outcome",
    "PermutationTest",
    "clustered_interval",
    "drive_outcome",
    "equivalence",
    "holm",
    "mcnemar_exact",
    "mcnemar_per_search",
    "permutation_test",
]

if TYPE_CHECKING:
    from advnerf_core.report.evidence.exact import (
        FEW_SEARCHES,
        McNemar,
        PermutationTest,
        holm,
        mcnemar_exact,
        mcnemar_per_search,
        permutation_test,
    )
    from advnerf_core.report.evidence.intervals import (
        ClusteredInterval,
        Equivalence,
        clustered_interval,
        equivalence,
    )
    from advnerf_core.report.evidence.outcome import Outcome, drive_outcome
else:
    # Reading a cell needs no SciPy.
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "advnerf_core.report.evidence.exact": "FEW_SEARCHES McNemar PermutationTest holm mcnemar_exact mcnemar_per_search permutation_test",
            "advnerf_core.report.evidence.intervals": "ClusteredInterval Equivalence clustered_interval equivalence",
            "advnerf_core.report.evidence.outcome": "Outcome drive_outcome",
        },
    )
