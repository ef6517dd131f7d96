"""Outcome of one attacked drive, compared with the drive from the same start without attack."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.driving.metrics import Horizon

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """Effect of an attack on one drive.

    Attributes:
        excess_cte_m_per_tick: Mean |CTE| of the attacked drive minus the mean of the drive without attack [m].
        off_track: Whether |CTE| of the attacked drive ever exceeded the off-track limit.
        collided_with: Name of the obstacle that the attacked car hit; None without a collision.
        time_to_leaving_s: Time of the first tick off the track [s]; None if the car never left it, or if only totals are stored.
        share_off_lane: Share of the ticks off the track, within 0..1; None if only totals are stored.
    """

    excess_cte_m_per_tick: float
    off_track: bool
    collided_with: str | None
    time_to_leaving_s: float | None
    share_off_lane: float | None


def drive_outcome(
    attacked_cte_m: ArrayLike,
    none_cte_m: ArrayLike,
    horizon: Horizon | None = None,
    collided_with: str | None = None,
) -> Outcome:
    """Compare an attacked drive with the drive from the same start without attack.

    The arrays come from :attr:`DriveMetrics.ctes_m`, where the ticks after a stop are already filled in.

    Args:
        attacked_cte_m: ``[T]`` signed CTE of the attacked drive at the ticks 1..T [m].
        none_cte_m: ``[T]`` signed CTE of the drive without attack [m].
        horizon: Number of ticks T, length of a tick and the off-track limit.
        collided_with: Name of the obstacle that the attacked car hit, if any.
    """
    limits = horizon or Horizon()
    attacked = _magnitudes_m("attacked", attacked_cte_m, limits.ticks)
    none = _magnitudes_m("none", none_cte_m, limits.ticks)
    if collided_with == "":
        raise ValueError(
            "expected the name of what the car hit, got an empty one; pass None if it hit nothing"
        )
    off = attacked > limits.off_track_m
    leaves = bool(off.any())
    return Outcome(
        excess_cte_m_per_tick=float((attacked.sum() - none.sum()) / limits.ticks),
        off_track=leaves,
        collided_with=collided_with,
        time_to_leaving_s=float((off.argmax() + 1) * limits.dt_s) if leaves else None,
        share_off_lane=float(off.mean()),
    )


def _magnitudes_m(name: str, cte_m: ArrayLike, ticks: int) -> Floats:
    """|CTE| ``[ticks]`` [m] of one drive, checked."""
    values = np.asarray(cte_m, dtype=np.float64)
    if values.shape != (ticks,):
        raise ValueError(
            f"expected the {name} drive's CTE at {ticks} ticks [{ticks}], got shape {list(values.shape)}; "
            "fill in the ticks after a stop (drive_metrics does), or pass the horizon that was driven"
        )
    if not np.isfinite(values).all():
        raise ValueError(
            f"expected finite CTE of the {name} drive, got {np.count_nonzero(~np.isfinite(values))} of {ticks} "
            "that are not; repeat the drive, or fill in the ticks at which the car was not tracked"
        )
    return np.abs(values)
