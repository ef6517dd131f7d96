"""What a report is made of: plain records with units, filled by the experiment and read by the tables, plots and page.

Everything optional may be missing; the page then says so. Images are ``[height, width, 3]`` uint8 RGB and are the only
fields that ``results.json`` leaves out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import transform_points
from advnerf_core.report.measurements import Fidelity, FidelityView, Hop, Latency, MemoryRow
from advnerf_core.report.record import Floats, Image, Record
from advnerf_core.report.reference import LiveLimit

Domain = Literal["surrogate", "deployed"]

__all__ = [
    "DOMAINS",
    "Clip",
    "Domain",
    "Fidelity",
    "FidelityView",
    "Hop",
    "Laps",
    "Latency",
    "LiveTries",
    "LossCurve",
    "Manifest",
    "MemoryRow",
    "ReportData",
    "Run",
    "Scene",
    "Settings",
    "StageTiming",
    "Texture",
    "face_segment",
]

DOMAINS: tuple[Domain, ...] = get_args(Domain)


@dataclass(frozen=True, eq=False)
class Settings(Record):
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

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("name", ("small", "full"))
        self.set_floats("start_poses", None, 3)


@dataclass(frozen=True, eq=False)
class Run(Record):
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
        mean_abs_cte_m: Mean of ``|CTE|`` [m].
        off_track: Whether ``|CTE|`` exceeded `Settings.off_track_m`.
        time_to_leave_s: When it first did [s]; None if never.
        clip: First-person video of this run; None if not filmed.
        attack_id: Short hash of the attack file; "" for none.
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
    mean_abs_cte_m: float
    off_track: bool
    time_to_leave_s: float | None = None
    clip: Path | None = None
    attack_id: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("domain", DOMAINS)
        self.check_named("condition")
        self.check_named("victim")
        self.set_floats("cte_m", None)
        self.set_floats("states", len(self.cte_m), 3)


@dataclass(frozen=True, eq=False)
class Scene(Record):
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

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "room_m", tuple(float(v) for v in self.room_m))
        self.set_floats("path_xy_m", None, 2)
        if self.fence_m is not None:
            self.set_floats("fence_m", None, 2)
        for name in ("board_m", "monitor_m"):
            if getattr(self, name) is not None:
                self.set_floats(name, 2, 2)


def face_segment(T_world_from_face: ArrayLike, width_m: float) -> NDArray[np.float64]:
    """Ends ``[2, 2]`` [m] of a face from above, for a frame at its centre with x its outward normal and z up."""
    ends = np.array([[0.0, -width_m / 2, 0.0], [0.0, width_m / 2, 0.0]])
    return transform_points(T_world_from_face, ends)[:, :2]


@dataclass(frozen=True, eq=False)
class LossCurve(Record):
    """Total CTE of each evaluation of one search, mean over the start poses, ``[E]`` [m], in order of evaluation."""

    method: str
    seed: int
    total_cte_m: Floats
    victim: str = "hardened"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_named("method")
        self.check_named("victim")
        self.set_floats("total_cte_m", None)


@dataclass(frozen=True, eq=False)
class Texture(Record):
    """What the face shows: row 0 is its top, column 0 its left for a viewer in front of it."""

    label: str
    condition: str
    image: Image | None
    attack_id: str = ""
    seed: int = 0
    victim: str = "hardened"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_named("condition")
        self.check_named("victim")
        self.check_image("image")


@dataclass(frozen=True, eq=False)
class Clip(Record):
    """A video for the page, such as surrogate, deployed clean and deployed attacked side by side."""

    title: str
    path: Path
    caption: str = ""


@dataclass(frozen=True, eq=False)
class StageTiming(Record):
    """Wall time of one stage [s]; `cached` means that its result was taken from an earlier run."""

    name: str
    wall_s: float
    cached: bool = False


@dataclass(frozen=True, eq=False)
class Laps(Record):
    """The live drive without attack: states ``[N, 3]`` (x [m], y [m], yaw [rad]) and signed CTE ``[N]`` [m] at the ticks."""

    laps: int
    states: Floats
    cte_m: Floats
    mean_abs_cte_m: float
    off_track: bool
    note: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.set_floats("cte_m", None)
        self.set_floats("states", len(self.cte_m), 3)


@dataclass(frozen=True, eq=False)
class LiveTries(Record):
    """How often the live node graph drove one arm.

    Attributes:
        condition: What the object showed.
        victim: Which policy.
        seed: Seed of the attack.
        driven: Whether all drives counted in the end. Otherwise the arm is "not driven live" and has no deployed runs.
        spoiled: Reasons of the tries that load or a fault of the stack spoiled, over all starts.
    """

    condition: str
    victim: str
    seed: int
    driven: bool
    spoiled: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_named("condition")
        self.check_named("victim")


@dataclass(frozen=True, eq=False)
class Manifest(Record):
    """How to make this report again.

    Attributes:
        command: The exact command line.
        created: Time of the report, ISO 8601 with zone.
        hashes: Of scene, policy, config, attack files, code, ...
        versions: Of the software.
        machine: Processor, cores, memory, system.
        wall_s: From the start of the command to the report [s], for a run with nothing cached; None if not measured.
    """

    command: str
    created: str
    hashes: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    machine: Mapping[str, str] = field(default_factory=dict)
    wall_s: float | None = None


@dataclass(frozen=True, eq=False)
class ReportData(Record):
    """Everything the report needs.

    `not_measured` gives the reason why a part is missing; its keys are the field names of the parts
    ("fidelity", "latency", "memory", "laps", "clips", ...). `limits` are what the report is held to.
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
    limits: tuple[LiveLimit, ...] = ()
    live_tries: tuple[LiveTries, ...] = ()
    not_measured: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        known = {f.name for f in fields(self)}
        if unknown := sorted(set(self.not_measured) - known):
            raise ValueError(
                f"expected ReportData.not_measured keys among {', '.join(sorted(known))}, got {unknown}"
            )

    @property
    def victims(self) -> tuple[str, ...]:
        """Names of the policies that were driven, in the order of their first runs."""
        return tuple(dict.fromkeys(run.victim for run in self.runs))

    def select(self, where: Callable[[Run], bool] | None = None, **equal: object) -> tuple[Run, ...]:
        """Runs whose fields equal the given values, such as ``domain="deployed"``, and for which ``where`` holds."""
        return tuple(
            r
            for r in self.runs
            if all(getattr(r, k) == v for k, v in equal.items()) and (where is None or where(r))
        )
