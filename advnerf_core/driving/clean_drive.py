"""The drive of a policy without an attack, the baseline of every result. No torch here, as attack files contain it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from advnerf_core.driving.metrics import DriveMetrics, Horizon, drives, mean_cte_limit_m
from advnerf_core.plain import PlainData


@dataclass(frozen=True)
class CleanDrive(PlainData):
    """Drives of a policy without an attack, in the scene of the search: one entry for each start pose.

    Attributes:
        total_cte_m: Total CTE of each drive [m].
        mean_cte_m: Mean |CTE| of each [m].
        max_cte_m: Largest |CTE| of each [m].
        ticks: Control ticks of a drive.
        off_track_m: |CTE| beyond which the car is off the track [m].
    """

    total_cte_m: tuple[float, ...]
    mean_cte_m: tuple[float, ...]
    max_cte_m: tuple[float, ...]
    off_track: tuple[bool, ...]
    ticks: int
    off_track_m: float

    def __post_init__(self) -> None:
        lists = (self.total_cte_m, self.mean_cte_m, self.max_cte_m, self.off_track)
        if not self.total_cte_m or len({len(each) for each in lists}) != 1:
            raise ValueError(
                f"expected one number of each kind for every start, got {[len(each) for each in lists]}"
            )
        if not np.isfinite([*self.total_cte_m, *self.mean_cte_m, *self.max_cte_m]).all():
            raise ValueError(
                "expected finite cross-track errors of the drive without an attack, got some that are not"
            )

    @classmethod
    def of(cls, metrics: Sequence[DriveMetrics], horizon: Horizon) -> CleanDrive:
        """Summarise the metrics of each drive over a horizon."""
        return cls(
            tuple(each.total_cte_m for each in metrics),
            tuple(each.mean_cte_m for each in metrics),
            tuple(each.max_cte_m for each in metrics),
            tuple(bool(each.off_track) for each in metrics),
            horizon.ticks,
            horizon.off_track_m,
        )

    @property
    def mean_total_cte_m(self) -> float:
        """Total CTE, averaged over the starts [m]: the baseline of an attack's total."""
        return float(np.mean(self.total_cte_m))

    @property
    def drives(self) -> bool:
        """Whether the policy drives at all, by `advnerf_core.driving.metrics.drives` over all starts."""
        return drives(float(np.mean(self.mean_cte_m)), any(self.off_track), self.off_track_m)

    @property
    def short(self) -> str:
        """The total in a few words."""
        return f"without attack {self.mean_total_cte_m:.2f} m" + ("" if self.drives else " (NO DRIVE)")

    @property
    def in_words(self) -> str:
        """The drive in one sentence."""
        return (
            f"drive without attack: total CTE {self.mean_total_cte_m:.2f} m over {self.ticks} ticks, mean |CTE| "
            f"{np.mean(self.mean_cte_m):.3f} m, at most {max(self.max_cte_m):.2f} m"
        )

    @property
    def warning(self) -> str:
        """Why the policy does not drive, and what to do; empty if it drives."""
        if self.drives:
            return ""
        left = sum(self.off_track)
        reasons = [
            f"it leaves the track (|CTE| > {self.off_track_m:g} m) from {left} of {len(self.off_track)} starts"
        ] * bool(left)
        mean_m, limit_m = float(np.mean(self.mean_cte_m)), mean_cte_limit_m(self.off_track_m)
        if mean_m > limit_m:
            reasons.append(f"its mean |CTE| is {mean_m:.3f} m, expected <= {limit_m:g} m")
        return (
            f"NO DRIVE: without an attack this policy does not drive here: {' and '.join(reasons)}. The total of an attack on it "
            "proves nothing; check its declaration, scene and starts, or train it for this place"
        )

    @property
    def lines(self) -> list[str]:
        """Lines to print beside a result: the drive, and a warning if it fails."""
        return [self.in_words, *([self.warning] if self.warning else [])]
