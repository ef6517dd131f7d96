"""Distance of a drive from its path: total cross-track error over a fixed horizon, the same in every domain.

Total CTE is the sum of |CTE| [m] at the control ticks 1..T after the start. If the car stops before the horizon ends, its
last |CTE| holds for the remaining ticks, capped, so that hitting a wall or the fence is not rewarded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.driving.path import Array, Path
from advnerf_core.errors import AdvnerfError

# The protocol's rule for driving without an attack, in metres: the car never leaves the track, and its mean |CTE| is at most
# this share of the off-track limit: 0.08 m in the lab, where the limit is 0.4 m.
MEAN_CTE_SHARE = 0.2
_STILL_M, _STILL_TICKS = 0.005, 3
# A tick inside a longer gap of a pose stream is an error [s].
_MAX_GAP_S = 0.5
LAB_OFF_TRACK_M = 0.4
# A drive begins when the armed car is farther than this from where it was armed [m].
MOVED_M = 0.01


def mean_cte_limit_m(off_track_m: float = LAB_OFF_TRACK_M) -> float:
    """Largest mean |CTE| of a policy that drives [m]."""
    return MEAN_CTE_SHARE * off_track_m


def no_effect_m(off_track_m: float = LAB_OFF_TRACK_M) -> float:
    """Largest mean excess |CTE| per tick that counts as no effect of an object [m]: half of what a policy that drives may deviate without one."""
    return 0.5 * mean_cte_limit_m(off_track_m)


def drives(mean_cte_m: float, off_track: bool, off_track_m: float = LAB_OFF_TRACK_M) -> bool:
    """Whether a policy drives: it never left the track, and stayed near its path on average.

    Args:
        mean_cte_m: Mean |CTE| over all drives [m].
        off_track: Whether any drive left the track.
        off_track_m: |CTE| beyond which the car is off the track [m].
    """
    return not off_track and mean_cte_m <= mean_cte_limit_m(off_track_m)


class PoseGapError(AdvnerfError, ValueError):
    """A control tick lies in a gap of a pose stream.

    Attributes:
        before_ns: Stamp of the last pose before the gap [ns].
        after_ns: Stamp of the first pose after it [ns].
    """

    def __init__(self, before_ns: int, after_ns: int) -> None:
        super().__init__(
            f"expected no gap over {_MAX_GAP_S} s in the pose stream, got {(after_ns - before_ns) * 1e-9:.2f} s: the car was not tracked, "
            "or its poses did not arrive; repeat"
        )
        self.before_ns, self.after_ns = before_ns, after_ns


@dataclass(frozen=True)
class Horizon:
    """Horizon of the sums, and the limits.

    Attributes:
        ticks: Number of control ticks.
        dt_s: Length of a tick [s].
        off_track_m: A larger |CTE| is off the track [m]; half a lane by default.
        held_cap_m: Greatest |CTE| that a stopped car is charged per tick [m].
    """

    ticks: int = 60
    dt_s: float = 0.1
    off_track_m: float = LAB_OFF_TRACK_M
    held_cap_m: float = 1.5

    def __post_init__(self) -> None:
        if self.ticks < 1 or not min(self.dt_s, self.off_track_m, self.held_cap_m) > 0.0:
            raise ValueError(f"expected at least one tick and positive limits, got {self}")

    def whole_ticks(self, time_s: float) -> int:
        """Number of control ticks that are over after a time [s]."""
        # 43 x 0.1 s / 0.1 s is a little less than 43.
        return math.floor(time_s / self.dt_s + 1e-6)


@dataclass(frozen=True)
class DriveMetrics:
    """Result of one drive.

    Attributes:
        total_cte_m: Sum of |CTE| over the horizon [m].
        mean_cte_m: Mean |CTE| over the horizon [m].
        max_cte_m: Greatest |CTE| over the horizon [m].
        off_track: Whether |CTE| ever exceeded the limit.
        time_to_leaving_s: Time of the first tick off the track [s]; None if it never left.
        held_ticks: Number of ticks that were filled in because the car had stopped.
        ctes_m: Signed CTE at the ticks 1..T [m]; held ticks carry the sign of the last one.
    """

    total_cte_m: float
    mean_cte_m: float
    max_cte_m: float
    off_track: bool
    time_to_leaving_s: float | None
    held_ticks: int
    ctes_m: tuple[float, ...]


def drive_metrics(
    path: Path, states: ArrayLike, horizon: Horizon | None = None, stopped_tick: int | None = None
) -> DriveMetrics:
    """Metrics of one trajectory sampled at the control ticks.

    Args:
        path: Reference path.
        states: ``[K, >= 2]`` rear-axle positions, ``states[0]`` at the start (not counted). Fewer than ``ticks + 1`` mean
            that the car stopped after the last one; more are ignored.
        stopped_tick: The car stands from this tick on, if known (see :func:`first_still_tick`).
    """
    return metrics_of_drives(path, [states], horizon, [stopped_tick])[0]


def metrics_of_drives(
    path: Path,
    drives: Sequence[ArrayLike],
    horizon: Horizon | None = None,
    stopped_ticks: Sequence[int | None] | None = None,
) -> list[DriveMetrics]:
    """`drive_metrics` of drives along one path, whose positions are projected together; ``stopped_ticks`` has one for each drive."""
    limits, positions = horizon or Horizon(), []
    stopped = [None] * len(drives) if stopped_ticks is None else stopped_ticks
    for states, stopped_tick in zip(drives, stopped, strict=True):
        xy = np.asarray(states, dtype=np.float64)
        if xy.ndim != 2 or xy.shape[0] < 2 or xy.shape[1] < 2 or not np.isfinite(xy).all():
            raise ValueError(
                f"expected finite states [K >= 2, >= 2] of one drive, got shape {list(xy.shape)}"
            )
        seen = min(xy.shape[0] - 1, limits.ticks)
        if stopped_tick is not None:
            seen = min(seen, max(stopped_tick, 1))
        positions.append(xy[1 : seen + 1, :2])
    if not positions:
        return []
    ctes = path.project(np.concatenate(positions)).cte_m
    parts = np.split(ctes, np.cumsum([len(each) for each in positions])[:-1])
    return [_of_ctes(part, limits) for part in parts]


def _of_ctes(ctes: Array, limits: Horizon) -> DriveMetrics:
    """Metrics of a drive by its signed CTE ``[K]`` [m] at the ticks 1..K, after which it stood."""
    held = limits.ticks - len(ctes)
    filled = np.concatenate([ctes, np.full(held, np.clip(ctes[-1], -limits.held_cap_m, limits.held_cap_m))])
    magnitude = np.abs(filled)
    off = np.flatnonzero(magnitude > limits.off_track_m)
    return DriveMetrics(
        total_cte_m=float(magnitude.sum()),
        mean_cte_m=float(magnitude.mean()),
        max_cte_m=float(magnitude.max()),
        off_track=off.size > 0,
        time_to_leaving_s=float((off[0] + 1) * limits.dt_s) if off.size else None,
        held_ticks=held,
        ctes_m=tuple(filled.tolist()),
    )


def first_still_tick(states: ArrayLike) -> int | None:
    """First tick from which the car stands still until the end of ``states [K, >= 2]``; None if it is still moving.

    The car stands within 5 mm of its last position; fewer than three still ticks at the end are no stop.
    """
    xy = np.asarray(states, dtype=np.float64)[:, :2]
    moving = np.flatnonzero(np.linalg.norm(xy - xy[-1], axis=1) > _STILL_M)
    first = int(moving[-1]) + 1 if moving.size else 0
    return first if len(xy) - first >= _STILL_TICKS else None


def states_at_ticks(
    stamps_ns: ArrayLike,
    poses: ArrayLike,
    start_ns: int,
    horizon: Horizon | None = None,
) -> Array:
    """Resample a pose stream (motion capture) at the control ticks.

    Args:
        stamps_ns: ``[N]`` strictly increasing stamps [ns].
        poses: ``[N, 3]`` x [m], y [m], yaw [rad]; yaw may be wrapped.
        start_ns: Stamp of tick 0, on the same clock, not before the first pose.
        horizon: Ticks wanted.

    Returns:
        ``[K, 3]`` states at the ticks 0..K-1, linear in time between poses, continuous yaw; shorter than the horizon if
        the stream ends early.

    Raises:
        PoseGapError: A tick lies in a gap of more than 0.5 s.
        ValueError: The stream is too short, its stamps repeat or go back, or it does not cover the start.
    """
    limits = horizon or Horizon()
    stamps, values = np.asarray(stamps_ns, dtype=np.int64), np.array(poses, dtype=np.float64)
    if (
        stamps.ndim != 1
        or values.shape != (len(stamps), 3)
        or len(stamps) < 2
        or (np.diff(stamps) <= 0).any()
    ):
        raise ValueError(
            f"expected >= 2 strictly increasing stamps [N] and poses [N, 3], got {list(stamps.shape)} and {list(values.shape)}"
        )
    ticks_ns = start_ns + np.round(np.arange(limits.ticks + 1) * limits.dt_s * 1e9).astype(np.int64)
    ticks_ns = ticks_ns[ticks_ns <= stamps[-1]]
    if start_ns < stamps[0] or len(ticks_ns) < 2:
        raise ValueError(
            f"expected a stream that covers the start {start_ns}, got {stamps[0]}..{stamps[-1]} ns"
        )
    _require_no_gap(stamps, ticks_ns)
    values[:, 2] = np.unwrap(values[:, 2])
    seconds, wanted = (stamps - start_ns) * 1e-9, (ticks_ns - start_ns) * 1e-9
    return np.stack([np.interp(wanted, seconds, values[:, k]) for k in range(3)], axis=1)


def _require_no_gap(stamps: NDArray[np.int64], ticks_ns: NDArray[np.int64]) -> None:
    after = np.searchsorted(stamps, ticks_ns, side="left")
    before = np.maximum(after - 1, 0)
    gaps_s = np.where(stamps[after] == ticks_ns, 0, stamps[after] - stamps[before]) * 1e-9
    if gaps_s.max() > _MAX_GAP_S:
        first = int((gaps_s > _MAX_GAP_S).argmax())
        raise PoseGapError(int(stamps[before[first]]), int(stamps[after[first]]))
