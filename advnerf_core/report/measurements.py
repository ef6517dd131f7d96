"""Records of what was measured about the surrogate, the live path and the adjoint's memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.report.record import Floats, Image, Record, as_floats


@dataclass(frozen=True, eq=False)
class FidelityView(Record):
    """One held-out view of the driving camera: the real image against the surrogate's.

    Attributes:
        label: Name of the view.
        psnr_full_db: PSNR at the camera's size [dB].
        psnr_policy_db: PSNR at the policy's size, 200x66 [dB].
        ssim_full: SSIM at the camera's size.
        ssim_policy: SSIM at the policy's size.
        steering_real_rad: The policy's output on the real image [rad].
        steering_surrogate_rad: The policy's output on the surrogate's image [rad].
        real: The real image, for the few views to be shown.
        surrogate: The surrogate's image.
    """

    label: str
    psnr_full_db: float
    psnr_policy_db: float
    ssim_full: float | None = None
    ssim_policy: float | None = None
    steering_real_rad: float | None = None
    steering_surrogate_rad: float | None = None
    real: Image | None = None
    surrogate: Image | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_image("real")
        self.check_image("surrogate")


@dataclass(frozen=True, eq=False)
class Fidelity(Record):
    """All held-out views; the aggregates are means over them, None where nothing was measured."""

    views: tuple[FidelityView, ...]

    def mean(self, name: str) -> float | None:
        """Mean of one numeric field of `FidelityView` over the views that have it."""
        values = [getattr(v, name) for v in self.views if getattr(v, name) is not None]
        return float(np.mean(values)) if values else None

    @property
    def steering_rad(self) -> NDArray[np.float64]:
        """Steering on the real and on the surrogate's image, ``[n, 2]`` [rad], of the views that have both."""
        pairs = [
            (v.steering_real_rad, v.steering_surrogate_rad)
            for v in self.views
            if v.steering_real_rad is not None and v.steering_surrogate_rad is not None
        ]
        return np.array(pairs, dtype=np.float64).reshape(-1, 2)

    @property
    def steering_difference_rad(self) -> float | None:
        """Mean absolute difference of the steering on real and surrogate images [rad]."""
        pairs = self.steering_rad
        return float(np.abs(pairs[:, 0] - pairs[:, 1]).mean()) if len(pairs) else None


@dataclass(frozen=True, eq=False)
class Hop(Record):
    """Latency of one hop of the live path [ms]."""

    name: str
    count: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def from_samples(cls, name: str, samples_ms: ArrayLike) -> Hop:
        """Percentiles of samples ``[n]`` [ms]."""
        a = as_floats(samples_ms)
        if a.size == 0:
            raise ValueError(f"expected latency samples of hop {name!r}, got none")
        p50, p95, p99 = np.percentile(a, [50, 95, 99])
        return cls(name, a.size, float(p50), float(p95), float(p99), float(a.max()))


@dataclass(frozen=True, eq=False)
class Latency(Record):
    """Live timing.

    Attributes:
        capture_to_serial_ms: From the capture of an image to the serial write it caused, per frame, ``[n]`` [ms].
        camera_period_ms: Time between frames [ms].
        missed_ticks: Control ticks without a command; None if not counted.
        hops: The same latency hop by hop.
    """

    capture_to_serial_ms: Floats
    camera_period_ms: float = 100.0
    missed_ticks: int | None = None
    hops: tuple[Hop, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.set_floats("capture_to_serial_ms", None)
        if len(self.capture_to_serial_ms) == 0:
            raise ValueError(
                "expected latency samples, got none: leave ReportData.latency at None if nothing was measured"
            )

    @property
    def overall(self) -> Hop:
        """Percentiles from capture to serial write."""
        return Hop.from_samples("capture to serial write", self.capture_to_serial_ms)


@dataclass(frozen=True, eq=False)
class MemoryRow(Record):
    """Peak memory above idle [MiB] at one horizon; `backprop_mib` is None where it was not run."""

    horizon_steps: int
    adjoint_mib: float
    backprop_mib: float | None = None
