"""Placement of samples on batches of rays: the settings, and the packed result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from advnerf_core.parallel import SLOTS, run_slots, slot_bounds
from advnerf_core.render.march_kernels import march
from advnerf_core.render.occupancy import Leaps

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class MarchConfig:
    """Placement of samples on rays.

    Attributes:
        near_m: Smallest sampled distance from the camera [m].
        smallest_step_m: Shortest sample interval [m].
        largest_step_m: Longest sample interval [m]; in a contracted field the inner region's.
        step_growth: Interval per metre of distance, between the two, because pixels get wider with distance.
        max_samples: Most samples on one ray.
    """

    near_m: float = 0.1
    smallest_step_m: float = 0.008
    largest_step_m: float = 0.08
    step_growth: float = 0.016
    max_samples: int = 384

    def __post_init__(self) -> None:
        if not 0.0 < self.smallest_step_m <= self.largest_step_m or self.max_samples < 1 or self.near_m < 0.0:
            raise ValueError(
                f"expected 0 < smallest_step_m <= largest_step_m and max_samples >= 1, got {self}"
            )

    def coarser(self, scale: float) -> MarchConfig:
        """The same with intervals ``scale`` times as long."""
        return replace(
            self,
            smallest_step_m=scale * self.smallest_step_m,
            largest_step_m=scale * self.largest_step_m,
            step_growth=scale * self.step_growth,
        )

    def in_unit(self, unit_m: float) -> MarchConfig:
        """The same with its lengths in another unit [m]."""
        return replace(
            self,
            near_m=self.near_m / unit_m,
            smallest_step_m=self.smallest_step_m / unit_m,
            largest_step_m=self.largest_step_m / unit_m,
        )

    def steps(self, scale: float = 1.0) -> Array32:
        """Smallest and largest interval [m] and growth ``[3]``, as the kernels read them."""
        return np.array(
            [self.smallest_step_m, self.largest_step_m, self.step_growth], np.float32
        ) * np.float32(scale)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples packed by ray.

    Attributes:
        points: ``[N, 3]`` sample positions in box coordinates, or in the cube of a contracted field.
        t_mid_m: Ray parameters ``[N]`` [m].
        widths: Intervals ``[N]`` in box coordinates.
        begins: First sample of each ray ``[R + 1]``.
    """

    points: Array32
    t_mid_m: Array32
    widths: Array32
    begins: NDArray[np.int64]

    @property
    def rays(self) -> int:
        """Number of rays."""
        return len(self.begins) - 1


class Marcher:
    """Packs the samples of a batch of rays; keeps its memory between batches.

    Args:
        capacity: Samples of a batch that fit. Later rays are left out.
        box_high: High corner of the box in box coordinates ``[3]``.
        contracted: Whether the field is contracted: rays then continue outside the box.
    """

    def __init__(
        self, capacity: int, config: MarchConfig, box_high: Array32, contracted: bool = False
    ) -> None:
        self.config, self.box_high, self.contracted = config, box_high, contracted
        # A ray is only begun where the longest one fits: without that reserve, many short rays would be left out.
        room = capacity // SLOTS + config.max_samples
        self._points, self._t = np.empty((SLOTS, room, 3), np.float32), np.empty((SLOTS, room), np.float32)
        self._widths = np.empty((SLOTS, room), np.float32)

    def __call__(
        self, rays: Array32, jitter: Array32, leaps: Leaps, step_scale: float = 1.0
    ) -> tuple[Samples, NDArray[np.int64]]:
        """Samples of the rays that fit, and the indices of these rays ``[R']``."""
        bounds = slot_bounds(len(rays), SLOTS)
        begins = [np.zeros(stop - start + 1, np.int64) for start, stop in bounds]
        fitted = [0] * SLOTS
        near, steps = np.float32(self.config.near_m), self.config.steps(step_scale)

        def work(slot: int) -> None:
            start, stop = bounds[slot]
            fitted[slot] = march(
                rays,
                jitter,
                start,
                stop,
                self.box_high,
                near,
                steps,
                leaps.distance,
                leaps.cells,
                self._points[slot],
                self._t[slot],
                self._widths[slot],
                begins[slot],
                self.config.max_samples,
                self.contracted,
            )

        run_slots(work, SLOTS)
        counts = [int(begins[slot][fitted[slot]]) for slot in range(SLOTS)]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        packed = [begins[slot][: fitted[slot]] + offsets[slot] for slot in range(SLOTS)]
        samples = Samples(
            np.concatenate([self._points[slot, : counts[slot]] for slot in range(SLOTS)]),
            np.concatenate([self._t[slot, : counts[slot]] for slot in range(SLOTS)]),
            np.concatenate([self._widths[slot, : counts[slot]] for slot in range(SLOTS)]),
            np.concatenate([*packed, offsets[-1:]]),
        )
        kept = np.concatenate(
            [np.arange(bounds[slot][0], bounds[slot][0] + fitted[slot]) for slot in range(SLOTS)]
        )
        return samples, kept
