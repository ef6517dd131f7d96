"""The data of an experiment's page: plain records with units, filled by the experiment and read by the plots and the page.

Everything optional may be missing; the page then says so. Images are ``[height, width, 3]`` uint8 RGB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import transform_points
from advnerf_core.report.reference import Domain

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
SHOWN_VIEWS = 6  # held-out views whose images a page shows


@dataclass(frozen=True, eq=False)
class Run:
    """One drive over the horizon.

    Attributes:
        condition: Condition of the object: "none" plain colours, a method's name the result of its search, "empty" no object at all;
            see `conditions`.
        seed: Seed of the attack; 0 without randomness.
        states: Pose of the rear axle at the control ticks, ``[T + 1, 3]``: x [m], y [m], yaw [rad], world.
        cte_m: Signed cross-track error at the control ticks, left positive, ``[T + 1]`` [m].
        note: Remark for readers, such as "stopped by the fence at 5.1 s".
    """

    domain: Domain
    condition: str
    victim: str
    seed: int
    start: int
    states: Floats
    cte_m: Floats
    note: str = ""


@dataclass(frozen=True, eq=False)
class Scene:
    """Contents of a map besides drives, all in world metres.

    Attributes:
        path_xy_m: Reference path, ``[N, 2]``.
        off_track_m: Half width of the band around it that counts as on track [m].
        closed: Whether the path is a loop.
        edges_m: Lines ``[N, 2]`` at the end of the road or the room.
        objects_m: Corners ``[N, 2]`` of each object from above.
        faces_m: Ends ``[2, 2]`` of faces from above, by name; the front is on the right of first to second.
        fence_m: Corners of the geofence, ``[M, 2]``; None without one.
    """

    path_xy_m: Floats
    off_track_m: float
    closed: bool = True
    edges_m: tuple[Floats, ...] = ()
    objects_m: tuple[Floats, ...] = ()
    faces_m: Mapping[str, Floats] = field(default_factory=dict)
    fence_m: Floats | None = None


def face_segment(T_world_from_face: ArrayLike, width_m: float) -> NDArray[np.float64]:
    """Ends ``[2, 2]`` [m] of a face from above, for a frame at its centre with x its outward normal and z up."""
    ends = np.array([[0.0, -width_m / 2, 0.0], [0.0, width_m / 2, 0.0]])
    return transform_points(T_world_from_face, ends)[:, :2]


@dataclass(frozen=True, eq=False)
class LossCurve:
    """The evaluations of one search.

    Attributes:
        values: Excess |CTE| per tick of each over the plain object, from its starts, over its ticks ``[E]`` [m]; with `Drives.maximised`
            the value of that instead, in its unit.
        plain: The same of the plain object; None if it is not known.
    """

    method: str
    values: Floats
    victim: str = "hardened"
    plain: float | None = 0.0


@dataclass(frozen=True)
class Maximised:
    """An objective other than ``cte``, and the unit of its values."""

    name: str
    unit: str


@dataclass(frozen=True, eq=False)
class Texture:
    """The displayed face: row 0 is its top, column 0 its left for a viewer in front of it."""

    label: str
    condition: str
    image: Image
    attack_id: str


@dataclass(frozen=True)
class Film:
    """A film of drives side by side.

    Attributes:
        file: The video.
        titles: Captions of the drives, left to right.
        moment: Number of the frame in which the last drive, which is the attacked one, is farthest from its path.
    """

    file: Path
    titles: tuple[str, ...]
    moment: int


@dataclass(frozen=True, eq=False)
class Drives:
    """All drives of one scenario.

    Attributes:
        scene: Contents of its maps.
        dt_s: Time between control ticks [s].
        curves: Loss curves of the searches.
        film: The driving camera's images past the plain, random and attacked object; None without a film.
        seen: Camera images of the objects, by method.
        maximised: What the searches maximised; None for the total CTE.
    """

    scenario: str
    scene: Scene
    dt_s: float
    runs: tuple[Run, ...]
    curves: tuple[LossCurve, ...] = ()
    film: Film | None = None
    seen: Mapping[str, Image] = field(default_factory=dict)
    maximised: Maximised | None = None

    @property
    def victims(self) -> tuple[str, ...]:
        """Names of the policies that were driven, in the order of their first runs."""
        return tuple(dict.fromkeys(run.victim for run in self.runs))

    def select(self, **equal: object) -> tuple[Run, ...]:
        """Runs with the given field values, such as ``domain="deployed"``."""
        return tuple(
            run for run in self.runs if all(getattr(run, key) == value for key, value in equal.items())
        )


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

    PSNR [dB] and SSIM are ``full`` at the camera's size and ``policy`` at the policy's, 200x66. The policy's output on either image is in
    radians [rad]; only the few views that are shown have their images.
    """

    label: str
    psnr_full_db: float
    psnr_policy_db: float
    ssim_full: float
    ssim_policy: float
    steering_real_rad: float
    steering_surrogate_rad: float
    real: Image | None = None
    surrogate: Image | None = None


@dataclass(frozen=True, eq=False)
class Fidelity:
    """All held-out views; the aggregates are means over them, None without any. ``unit`` is the unit of the policy's control."""

    views: tuple[FidelityView, ...]
    unit: str = "rad"

    def mean(self, name: str) -> float | None:
        """Mean of one numeric field of `FidelityView` over the views."""
        values = [getattr(v, name) for v in self.views]
        return float(np.mean(values)) if values else None

    @property
    def steering_rad(self) -> NDArray[np.float64]:
        """Steering on the real and on the surrogate's image of each view, ``[n, 2]`` [rad]."""
        pairs = [(v.steering_real_rad, v.steering_surrogate_rad) for v in self.views]
        return np.array(pairs, dtype=np.float64).reshape(-1, 2)

    @property
    def steering_difference_rad(self) -> float | None:
        """Mean absolute difference of the steering on real and surrogate images [rad]."""
        pairs = self.steering_rad
        return float(np.abs(pairs[:, 0] - pairs[:, 1]).mean()) if len(pairs) else None


@dataclass(frozen=True, eq=False)
class Latency:
    """Live timing.

    Attributes:
        capture_to_serial_ms: From the capture of an image to the serial write it caused, per frame, ``[n]`` [ms].
        camera_period_ms: Time between frames [ms].
        missed_ticks: Control ticks without a command.
        hops_ms: The time from capture to the publication by each node, ``[n]`` by hop [ms].
    """

    capture_to_serial_ms: Floats
    camera_period_ms: float
    missed_ticks: int
    hops_ms: Mapping[str, Floats]

    @property
    def p99_ms(self) -> float:
        """99th percentile from capture to serial write [ms]."""
        return float(np.percentile(self.capture_to_serial_ms, 99))


@dataclass(frozen=True, eq=False)
class Manifest:
    """Commands and versions that reproduce this report, and the wall time of each stage [s].

    Hashes are of scene, policy, config, attack files and code; the machine is its processor, cores, memory and system.
    """

    command: str
    hashes: Mapping[str, str]
    versions: Mapping[str, str]
    machine: Mapping[str, str]
    settings: Mapping[str, str]
    timings: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class ReportData:
    """Input of the sections of an experiment's page.

    Attributes:
        overview: The world from above; None if it has no such picture.
        done: What was searched and driven, in one paragraph.
        live: Whether the drives were live; the following fields are then shown, or named as missing.
        not_measured: Reason for a missing part, by its name.
    """

    drives: tuple[Drives, ...]
    manifest: Manifest
    overview: Image | None = None
    textures: tuple[Texture, ...] = ()
    fidelity: Fidelity | None = None
    done: str = ""
    live: bool = False
    latency: Latency | None = None
    laps: Laps | None = None
    not_measured: Mapping[str, str] = field(default_factory=dict)

    @property
    def measured(self) -> dict[str, float | None]:
        """Measures besides those of drives, by their name in a `Limit`; None or absent if this run has none."""
        found: dict[str, float | None] = {}
        if self.fidelity is not None:
            found |= {name: self.fidelity.mean(name) for name in ("psnr_full_db", "psnr_policy_db")}
            found["steering_difference_rad"] = self.fidelity.steering_difference_rad
        if self.laps is not None:
            found |= {"laps": self.laps.laps, "laps_mean_abs_cte_m": self.laps.mean_abs_cte_m}
            found["laps_off_track"] = float(self.laps.off_track)
        if self.latency is not None:
            found |= {
                "latency_p99_ms": self.latency.p99_ms,
                "missed_ticks": self.latency.missed_ticks,
            }
        return found
