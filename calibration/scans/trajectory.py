"""Poses over time, and the pose of each image by its time stamp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, interpolate_transform, make_transform, rotation_from_quaternion
from calibration.scans.scan import ScanError

NS_PER_S = 1_000_000_000
# As in the tools of the TUM benchmark.
_NEAREST_NS = 20_000_000
# Longer gaps are not bridged: a camera in a hand does not move evenly for so long.
_BRIDGED_NS = 100_000_000
_LARGEST_S = 9e9


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses by time.

    Attributes:
        stamps_ns: Times ``[N]``, ascending [ns].
        poses: ``[N, 4, 4]``.
        dropped: Number of rows without a usable pose.
        file: File of the poses.
    """

    stamps_ns: NDArray[np.int64]
    poses: Array
    dropped: int
    file: Path

    def at(self, stamp_ns: int) -> Array | None:
        """Pose ``[4, 4]`` at a time: between two poses less than 0.1 s apart, or the nearest within 20 ms; None without a pose."""
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        near = [index for index in (after - 1, after) if 0 <= index < len(self.stamps_ns)]
        if len(near) == 2:
            gap = int(self.stamps_ns[after] - self.stamps_ns[after - 1])
            if gap <= _BRIDGED_NS:
                fraction = int(stamp_ns - self.stamps_ns[after - 1]) / gap
                return interpolate_transform(self.poses[after - 1], self.poses[after], fraction)
        nearest = min(near, key=lambda index: abs(int(self.stamps_ns[index]) - stamp_ns))
        return self.poses[nearest] if abs(int(self.stamps_ns[nearest]) - stamp_ns) <= _NEAREST_NS else None

    def without_images(self, stamps_ns: Sequence[int]) -> ScanError:
        """The error if no image has a pose."""
        ours, theirs = (
            f"{min(each) / NS_PER_S:.3f} .. {max(each) / NS_PER_S:.3f} s"
            for each in (self.stamps_ns, stamps_ns)
        )
        return ScanError(
            f"{self.file}: expected poses within 20 ms of the images, got poses at {ours} and images at {theirs}; "
            "give the trajectory of this recording, with the clock of its images"
        )


def trajectory_of(stamps_ns: Sequence[int], values: Array, file: Path) -> Trajectory:
    """Poses from rows; rows without a usable pose are dropped.

    Args:
        stamps_ns: Time of each row [ns].
        values: Rows ``x y z qx qy qz qw``, ``[N, 7]``.

    Raises:
        ScanError: No row is usable.
    """
    found: dict[int, Array] = {}
    for stamp, row in zip(stamps_ns, values, strict=True):
        try:
            if np.isfinite(row).all():
                found[stamp] = make_transform(rotation_from_quaternion(row[3:]), row[:3])
        except ValueError:  # trackers write zeros where they lost the body
            continue
    if not found:
        raise ScanError(
            f"{file}: expected rows with a position and a quaternion, got {len(values)} rows and none of them usable; export the trajectory again"
        )
    order = sorted(found)
    return Trajectory(
        np.array(order, np.int64), np.stack([found[stamp] for stamp in order]), len(values) - len(found), file
    )


def require_order(names: Sequence[str], axes: str, file: Path) -> None:
    """Refuse a trajectory whose header names its columns in another order, such as ``qx qy qz qw`` for ``qw qx qy qz``.

    Args:
        names: Names of the columns of position and quaternion.
        axes: The expected last letters of these names, such as ``xyzwxyz``. A header with other letters says nothing.

    Raises:
        ScanError: The order is another.
    """
    got = "".join(name.partition("[")[0].strip()[-1:].lower() for name in names)
    if got != axes and sorted(got) == sorted(axes):
        raise ScanError(
            f"{file}: expected columns of a position and a quaternion in the order {', '.join(axes)}, got {', '.join(map(str.strip, names))}; "
            "export the trajectory again in that order"
        )


def stamp_ns(seconds: float, where: str) -> int:
    """A time in nanoseconds.

    Raises:
        ScanError: The text is not a time in seconds.
    """
    if not abs(seconds) < _LARGEST_S:
        raise ScanError(f"{where}: expected a time in seconds, got {seconds:g}; write seconds")
    return round(seconds * NS_PER_S)
