"""Interpolates the poses of a subject at the capture stamp of an image.

Using the newest pose instead would give a different result in every replay. It would also be wrong: at 1.5 m/s and 50 Hz, its
median error is 6 mm, but 0.1 mm with interpolation at the stamp.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import interpolate_transform

_NS_PER_S = 1_000_000_000
_WHOLE_RECORDING_S = 1e6
# Shortest time over which velocity is estimated. Over one period of the stream, the estimate would be mostly noise.
_VELOCITY_BASE_S = 0.02


@dataclass(frozen=True, eq=False)
class TimedPose:
    """A pose at a stamp.

    Attributes:
        T: Transform ``[4, 4]``.
        extrapolated_s: Time after the newest pose [s]; 0 if the pose is interpolated.
    """

    T: NDArray[np.float64]
    extrapolated_s: float


class PoseBuffer:
    """The recent poses of one subject, by capture stamp.

    Args:
        keep_s: Poses that are this much older than the newest are discarded [s].
        max_gap_s: Longest gap in the stream across which poses are interpolated [s].
    """

    def __init__(self, keep_s: float = 2.0, max_gap_s: float = 0.1) -> None:
        if keep_s <= 0.0 or max_gap_s <= 0.0:
            raise ValueError(f"expected positive times, got keep_s {keep_s} and max_gap_s {max_gap_s}")
        self._keep_ns = round(keep_s * _NS_PER_S)
        self._max_gap_ns = round(max_gap_s * _NS_PER_S)
        self._stamps: list[int] = []
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._late = False

    @classmethod
    def of_recording(
        cls, poses: Iterable[tuple[int, NDArray[np.float64]]], max_gap_s: float = 0.1
    ) -> PoseBuffer:
        """Keep all poses of a recording, given with their stamps [ns]."""
        buffer = cls(_WHOLE_RECORDING_S, max_gap_s)
        for stamp_ns, T in poses:
            buffer.add(stamp_ns, T)
        return buffer

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, T: NDArray[np.float64]) -> None:
        """Add a pose. Poses may arrive in any order; of two with the same stamp, the first is kept.

        A pose that is older than all that are kept is late, and ignored. Two in a row show that a clock was set back: the buffer starts
        again with the second.
        """
        if stamp_ns in self._poses:
            return
        late, self._late = self._late, bool(self._stamps) and stamp_ns < self._stamps[-1] - self._keep_ns
        if self._late and not late:
            return
        if self._late:
            self._late = False
            self._stamps.clear()
            self._poses.clear()
        insort(self._stamps, stamp_ns)
        self._poses[stamp_ns] = np.array(T, dtype=np.float64)
        first = bisect_left(self._stamps, self._stamps[-1] - self._keep_ns)
        for old in self._stamps[:first]:
            del self._poses[old]
        del self._stamps[:first]

    def reaches(self, stamp_ns: int) -> bool:
        """Whether there is a pose at or after the stamp, so that waiting longer is useless."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def at(self, stamp_ns: int, extrapolation_limit_s: float = 0.0) -> TimedPose | None:
        """Return the pose at a stamp: interpolated, or extrapolated at constant velocity beyond the newest pose.

        Returns:
            None if the stamp is before the first pose, in a gap, or further ahead than the limit.
        """
        index = bisect_left(self._stamps, stamp_ns)
        if index == len(self._stamps):
            return self._ahead(stamp_ns, extrapolation_limit_s)
        after = self._stamps[index]
        if after == stamp_ns:
            return TimedPose(self._poses[after].copy(), 0.0)
        if index == 0 or after - self._stamps[index - 1] > self._max_gap_ns:
            return None
        return TimedPose(self._between(self._stamps[index - 1], after, stamp_ns), 0.0)

    def _ahead(self, stamp_ns: int, limit_s: float) -> TimedPose | None:
        if len(self._stamps) < 2:
            return None
        newest = self._stamps[-1]
        ahead_s = (stamp_ns - newest) / _NS_PER_S
        base = max(0, bisect_left(self._stamps, newest - round(_VELOCITY_BASE_S * _NS_PER_S) + 1) - 1)
        base = min(base, len(self._stamps) - 2)
        if ahead_s > limit_s or newest - self._stamps[base] > self._max_gap_ns:
            return None
        return TimedPose(self._between(self._stamps[base], newest, stamp_ns), ahead_s)

    def _between(self, start_ns: int, end_ns: int, stamp_ns: int) -> NDArray[np.float64]:
        fraction = (stamp_ns - start_ns) / (end_ns - start_ns)
        return interpolate_transform(self._poses[start_ns], self._poses[end_ns], fraction)
