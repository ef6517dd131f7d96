"""What a search tells while it runs."""

from __future__ import annotations

from collections.abc import Callable

from advnerf_core.attack.search.search import Evaluation, OnEvaluation
from advnerf_core.driving.clean_drive import CleanDrive


def telling(
    evaluations: int, report: Callable[[float, str], None], of: str = "", clean: CleanDrive | None = None
) -> OnEvaluation:
    """Evaluations as progress: the fraction done, and in words, after ``of``, the last and the best total, and that without attack."""
    best_m, beside = 0.0, "" if clean is None else f", {clean.short}"

    def told(evaluation: Evaluation) -> None:
        nonlocal best_m
        total_m, done = evaluation.predicted_total_cte_m, evaluation.iteration + 1
        best_m = max(best_m, total_m)
        report(
            done / evaluations,
            f"{of}{done}/{evaluations}, total CTE {total_m:.1f} m, best {best_m:.1f} m{beside}",
        )

    return told
