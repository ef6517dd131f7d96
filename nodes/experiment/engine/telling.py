"""Progress reports of a running search."""

from __future__ import annotations

from collections.abc import Callable

from advnerf_core.attack.objective import CrossTrackError, Objective
from advnerf_core.attack.search.record import Evaluation, OnEvaluation
from advnerf_core.driving.clean_drive import CleanDrive


def telling(
    evaluations: int,
    report: Callable[[float, str], None],
    clean: CleanDrive | None = None,
    objective: Objective | None = None,
) -> OnEvaluation:
    """A callback that reports evaluations as progress: the finished fraction, and as text the last and the best total, and the total without attack.

    The last and the best value of an objective other than ``cte`` are reported too.
    """
    best: Evaluation | None = None
    beside = "" if clean is None else f", {clean.short}"

    def told(evaluation: Evaluation) -> None:
        nonlocal best
        if best is None or evaluation.value > best.value:
            best = evaluation
        done, total_m, best_m = (
            evaluation.iteration + 1,
            evaluation.predicted_total_cte_m,
            best.predicted_total_cte_m,
        )
        text = f"total CTE {total_m:.1f} m, best {best_m:.1f} m"
        if objective is not None and objective != CrossTrackError():
            unit = objective.unit
            text = f"{evaluation.value:.2f} {unit}, best {best.value:.2f} {unit}, total CTE {total_m:.1f} m"
        report(done / evaluations, f"{done}/{evaluations}, {text}{beside}")

    return told
