"""The statistics of published results: outcomes in metres, clustered intervals, and registered tests.

Intervals describe every result. Tests are few and registered beforehand, and `holm` adjusts exactly those.
"No effect" is claimed by `equivalence` alone.
"""

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
