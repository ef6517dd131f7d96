"""What the page of live drives is made of: plain records with units, filled by the experiment and read by the plots and the page.

Everything optional may be missing; the page then says so. Images are ``[height, width, 3]`` uint8 RGB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import transform_points
from advnerf_core.report.reference import Domain

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
_TICKS_COMPARED = (50, 400)  # horizons whose memory is compared


@dataclass(frozen=True, eq=False)
class Settings:
    """The experiment's numbers.

    Attributes:
        name: "small" (``make demo``) or "full" (``make experiment``).
        horizon_steps: T, control ticks per run.
        control_period_s: Time between control ticks [s].
        iterations: Gradient steps of the attack.
        random_evaluations: Textures tried by the random search.
        start_poses: Start of each run, ``[S, 3]``: x [m], y [m], yaw [rad]; `Run.start` indexes it.
        seeds: Seeds of the attack.
        speed_mps: Driving speed [m/s].
        learning_rate: Of Adam, on the colour grid.
        off_track_m: Off-track means ``|CTE|`` above this [m].
        extra: Anything else worth printing, name to value.
    """

    name: Literal["small", "full"]
    horizon_steps: int
    control_period_s: float
    iterations: int
    random_evaluations: int
    start_poses: Floats
    seeds: tuple[int, ...]
    speed_mps: float
    learning_rate: float = 0.1
    off_track_m: float = 0.4
    extra: Mapping[str, str | float | int | bool] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Run:
    """One drive over the horizon.

    Attributes:
        domain: Where it was driven: in the learned scene or by the live node graph.
        condition: What the object shows: "none" plain colours, the name of a method what it found, "empty" no object at all;
            see `conditions`.
        victim: Name of the policy: "hardened" has seen random textures in training, "naive" has not, others are a user's.
        seed: Seed of the attack; 0 where nothing is random.
        start: Index into `Settings.start_poses`.
        states: Pose of the rear axle at the control ticks, ``[T + 1, 3]``: x [m], y [m], yaw [rad], world.
        cte_m: Signed cross-track error at the control ticks, left positive, ``[T + 1]`` [m].
        total_cte_m: Sum of ``|CTE|`` over the horizon [m].
        note: What a reader must know, such as "stopped by the fence at 5.1 s".
    """

    domain: Domain
    condition: str
    victim: str
    seed: int
    start: int
    states: Floats
    cte_m: Floats
    total_cte_m: float
    note: str = ""


@dataclass(frozen=True, eq=False)
class Scene:
    """The room from above, all in world metres.

    Attributes:
        path_xy_m: Reference path, ``[N, 2]``.
        off_track_m: Half width of the band around it that counts as on track [m].
        room_m: Walls: x min, y min, x max, y max [m].
        fence_m: Corners of the geofence, ``[M, 2]``; None without one.
        board_m: Ends of the attacked face seen from above, ``[2, 2]``; its front is on the right of first to second.
        monitor_m: The same of the monitor.
        tape_width_m: Width of the tape [m].
        closed: Whether the path is a loop.
    """

    path_xy_m: Floats
    off_track_m: float
    room_m: tuple[float, float, float, float]
    fence_m: Floats | None = None
    board_m: Floats | None = None
    monitor_m: Floats | None = None
    tape_width_m: float = 0.05
    closed: bool = True


def face_segment(T_world_from_face: ArrayLike, width_m: float) -> NDArray[np.float64]:
    """Ends ``[2, 2]`` [m] of a face from above, for a frame at its centre with x its outward normal and z up."""
    ends = np.array([[0.0, -width_m / 2, 0.0], [0.0, width_m / 2, 0.0]])
    return transform_points(T_world_from_face, ends)[:, :2]


@dataclass(frozen=True, eq=False)
class LossCurve:
    """Total CTE of each evaluation of one search, mean over the start poses, ``[E]`` [m], in order of evaluation."""

    method: str
    seed: int
    total_cte_m: Floats
    victim: str = "hardened"


@dataclass(frozen=True, eq=False)
class Texture:
    """What the face shows: row 0 is its top, column 0 its left for a viewer in front of it."""

    label: str
    condition: str
    image: Image | None
    attack_id: str = ""
    seed: int = 0
    victim: str = "hardened"


@dataclass(frozen=True, eq=False)
class Clip:
    """A video for the page, such as surrogate, deployed clean and deployed attacked side by side."""

    title: str
    path: Path
    caption: str = ""


@dataclass(frozen=True, eq=False)
class StageTiming:
    """Wall time of one stage [s]."""

    name: str
    wall_s: float


@dataclass(frozen=True, eq=False)
class Laps:
    """The live drive without attack: states ``[N, 3]`` (x [m], y [m], yaw [rad]) and signed CTE ``[N]`` [m] at the ticks."""

    laps: int
    states: Floats
    cte_m: Floats
    mean_abs_cte_m: float
    off_track: bool


@dataclass(frozen=True, eq=False)
class FidelityView:
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


@dataclass(frozen=True, eq=False)
class Fidelity:
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
class Hop:
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
        a = np.asarray(samples_ms, dtype=np.float64)
        if a.size == 0:
            raise ValueError(f"expected latency samples of hop {name!r}, got none")
        p50, p95, p99 = np.percentile(a, [50, 95, 99])
        return cls(name, a.size, float(p50), float(p95), float(p99), float(a.max()))


@dataclass(frozen=True, eq=False)
class Latency:
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

    @property
    def overall(self) -> Hop:
        """Percentiles from capture to serial write."""
        return Hop.from_samples("capture to serial write", self.capture_to_serial_ms)


@dataclass(frozen=True, eq=False)
class MemoryRow:
    """Peak memory above idle of one adjoint gradient at one horizon [MiB]."""

    horizon_steps: int
    adjoint_mib: float


@dataclass(frozen=True, eq=False)
class Manifest:
    """How to make this report again.

    Attributes:
        command: The exact command line.
        created: Time of the report, ISO 8601 with zone.
        hashes: Of scene, policy, config, attack files, code, ...
        versions: Of the software.
        machine: Processor, cores, memory, system.
    """

    command: str
    created: str
    hashes: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    machine: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything the report needs.

    `not_measured` gives the reason why a part is missing; its keys are the field names of the parts
    ("fidelity", "latency", "memory", "laps", "clips", ...).
    """

    settings: Settings
    scene: Scene
    runs: tuple[Run, ...]
    manifest: Manifest
    curves: tuple[LossCurve, ...] = ()
    textures: tuple[Texture, ...] = ()
    clips: tuple[Clip, ...] = ()
    fidelity: Fidelity | None = None
    latency: Latency | None = None
    memory: tuple[MemoryRow, ...] = ()
    timings: tuple[StageTiming, ...] = ()
    laps: Laps | None = None
    not_measured: Mapping[str, str] = field(default_factory=dict)

    @property
    def measured(self) -> dict[str, float | None]:
        """Measures besides those of drives, by the name that a `Limit` has for them; None or absent where this run has none."""
        found: dict[str, float | None] = {}
        if self.fidelity is not None:
            found |= {name: self.fidelity.mean(name) for name in ("psnr_full_db", "psnr_policy_db")}
            found["steering_difference_rad"] = self.fidelity.steering_difference_rad
        if self.laps is not None:
            found |= {"laps": self.laps.laps, "laps_mean_abs_cte_m": self.laps.mean_abs_cte_m}
            found["laps_off_track"] = float(self.laps.off_track)
        if self.latency is not None:
            found |= {
                "latency_p99_ms": self.latency.overall.p99_ms,
                "missed_ticks": self.latency.missed_ticks,
            }
        rows = {row.horizon_steps: row.adjoint_mib for row in self.memory}
        short, long = (rows.get(ticks) for ticks in _TICKS_COMPARED)
        return {**found, "memory_ratio": long / short} if short and long else found

    @property
    def victims(self) -> tuple[str, ...]:
        """Names of the policies that were driven, in the order of their first runs."""
        return tuple(dict.fromkeys(run.victim for run in self.runs))

    def select(self, **equal: object) -> tuple[Run, ...]:
        """Runs whose fields equal the given values, such as ``domain="deployed"``."""
        return tuple(
            run for run in self.runs if all(getattr(run, key) == value for key, value in equal.items())
        )
