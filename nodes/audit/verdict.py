"""The judgement of drives from the judging starts: the effect with its interval, and whether the object drives the policy out of its lane.

The judging starts were used by no search and for no choice, so that the number of candidates does not widen the interval. The effect
is paired by start, against the control with the smaller difference. The interval is `mean_estimate.one_sample`'s. That the object,
and nothing else, drives the car off is tested exactly on the starts where only one of the two leaves the lane (McNemar 1947).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from advnerf_core.driving.metrics import DriveMetrics
from advnerf_core.report.audit_result import AuditEffect, Control
from advnerf_core.report.evidence.mean_estimate import one_sample

Floats = NDArray[np.float64]
LEVEL = 0.95


@dataclass(frozen=True, eq=False)
class ArmDrives:
    """Drives from the same starts.

    Attributes:
        states: ``[S, T + 1, n]``: x [m], y [m], yaw [rad].
        largest_m: Largest |CTE| of each ``[S]`` [m].
        mean_m: Mean |CTE| of each ``[S]`` [m].
        driven_ticks: Ticks until each car stopped ``[S]``; later states repeat the last one.
    """

    states: Floats
    largest_m: Floats
    mean_m: Floats
    driven_ticks: NDArray[np.int64]

    @classmethod
    def of(cls, states: Floats, scores: Sequence[DriveMetrics], driven_ticks: Any) -> ArmDrives:
        """Drives with their scores."""
        return cls(
            states,
            np.array([score.max_cte_m for score in scores]),
            np.array([score.mean_cte_m for score in scores]),
            np.array(driven_ticks),
        )

    def left(self, limit_m: float) -> NDArray[np.bool_]:
        """Whether each drive left the lane ``[S]``."""
        return np.asarray(self.largest_m > limit_m)


@dataclass(frozen=True)
class EffectJudgement:
    """Effect of the object.

    Attributes:
        control: The control with the smaller effect.
        effect: Increase of the car's largest distance from the path over that control.
        left: Starts from which the car left its lane with the object, and with each control.
        starts: Number of starts.
        p: p of the exact test that the object drives the car off no more often than the worse of the controls.
    """

    control: Control
    effect: AuditEffect
    left: Mapping[str, int]
    starts: int
    p: float

    @property
    def found(self) -> bool:
        """Whether the object drives the policy out of its lane."""
        return self.p <= 1.0 - LEVEL


def judge(attacked: ArmDrives, controls: Mapping[Control, ArmDrives], limit_m: float) -> EffectJudgement:
    """Judge an object by its drives and the controls' from the same starts."""
    effects = {name: effect_of(attacked, drives) for name, drives in controls.items()}
    control = min(effects, key=lambda name: effects[name].mean_m)
    by_object = attacked.left(limit_m)
    by_control = {name: each.left(limit_m) for name, each in controls.items()}
    return EffectJudgement(
        control,
        effects[control],
        {"object": int(by_object.sum()), **{name: int(each.sum()) for name, each in by_control.items()}},
        len(attacked.largest_m),
        paired_p(by_object, np.any(list(by_control.values()), axis=0)),
    )


def effect_of(attacked: ArmDrives, control: ArmDrives) -> AuditEffect:
    """Increase of the largest |CTE|, mean over the starts, with its 95 % interval [m]."""
    return _effect(attacked.largest_m - control.largest_m)


def _effect(differences_m: Floats, level: float = LEVEL) -> AuditEffect:
    estimate = one_sample(differences_m)
    low, high = estimate.ends(level)
    mean = float(estimate.mean)
    return AuditEffect(mean_m=mean, low_m=min(mean, float(low)), high_m=max(mean, float(high)), level=level)


def paired_p(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """One-sided p of the exact McNemar test that ``one`` happens no more often than ``other`` from the same starts."""
    only_one, only_other = int((one & ~other).sum()), int((other & ~one).sum())
    if only_one + only_other == 0:
        return 1.0
    return float(binomtest(only_one, only_one + only_other, 0.5, alternative="greater").pvalue)


def change_of(now: ArmDrives, then: ArmDrives, of_several: int = 1) -> AuditEffect:
    """Increase of the largest |CTE| since then, mean over the same starts [m].

    The interval is that of the largest of so many compared changes (Bonferroni).
    """
    return _effect(now.largest_m - then.largest_m, 1.0 - (1.0 - LEVEL) / of_several)
