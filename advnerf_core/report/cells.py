"""One cell of an experiment: a scenario, a victim, a method and a seed, with its drives in the surrogate and in the deployment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, model_validator

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.reference import Domain
from advnerf_core.strict import StrictModel

Metres = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class CellError(AdvnerfError, ValueError):
    """A cell's file is invalid."""


class Drives(StrictModel):
    """The drives of one cell in one domain, one entry per start pose.

    Attributes:
        total_cte_m: Total CTE of each drive [m].
        off_track: Whether each left its track.
        none_total_cte_m: Total CTE of each start without attack, in the same domain [m].
    """

    model_config = ConfigDict(extra="allow")

    total_cte_m: tuple[Metres, ...] = Field(min_length=1)
    off_track: tuple[bool, ...]
    none_total_cte_m: tuple[Metres, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _of_one_length(self) -> Drives:
        counts = (len(self.off_track), len(self.none_total_cte_m))
        if any(count != len(self.total_cte_m) for count in counts):
            raise ValueError(
                f"expected one off_track and one none_total_cte_m for each of {len(self.total_cte_m)} drives, got {counts[0]} and {counts[1]}"
            )
        return self

    @property
    def mean_m(self) -> float:
        """Mean total CTE over the drives [m]."""
        return sum(self.total_cte_m) / len(self.total_cte_m)


class CellResult(StrictModel):
    """Result of a finished cell. The drives of both domains begin at the same starts in the same order; one domain may have only the first of them.

    Attributes:
        scenario: straight, right, left, green_screen, monitor or another.
        victim: ``hardened``, ``naive`` or ``retrained``.
        method: ``none``, or the name of the method of attack.
        seed: Seed of starts and search.
        placement: Empty; in the files of sets from when the places of objects had names.
        attack_id: Id of the attack file; None for none.
        settings_hash: Hash of everything that the result depends on.
        settings: All of these settings, including defaults; empty in cells from before they were stored.
        stages: Digests of the capture, scene, object and policy stages' outputs; empty in cells from before they were stored.
        seconds: Duration of the cell, also of its drives [s]; in older files of its search alone.
        date: Date and time, ISO.
        surrogate: Drives in the learned scene; for an attack over the deployment scene's own frames (meshes) the ideal car's drives there.
        deployed: Drives in the deployment; None until they are driven.
        not_driven_live: Reason why live nodes could not drive it, because load or a fault of the stack spoiled all tries; else empty. Such
            a cell is never evidence.
        registration: Digest of the registration that the cell was run under; empty without one.
        policy_sha256: Content hash of the victim; empty in cells from before it was stored.
        kept: Published data of each domain's drives, for recomputing the numbers; empty in cells from before they were stored.
        extra: Further data, such as the file of a clip.
    """

    model_config = ConfigDict(extra="allow")

    scenario: str = Field(min_length=1)
    victim: str = Field(min_length=1)
    method: str = Field(min_length=1)
    seed: int
    placement: Literal[""] = ""
    attack_id: str | None = None
    settings_hash: str
    settings: dict[str, Any] = Field(default_factory=dict)
    stages: dict[str, str] = Field(default_factory=dict)
    seconds: Annotated[float, Field(ge=0.0)]
    machine: str
    date: str
    surrogate: Drives
    deployed: Drives | None = None
    not_driven_live: str = ""
    registration: str = ""
    policy_sha256: str = ""
    kept: dict[Domain, tuple[KeptDrive, ...]] = Field(default_factory=dict)
    extra: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _driven_or_not(self) -> CellResult:
        if self.not_driven_live and (self.deployed is not None or "deployed" in self.kept):
            raise ValueError("expected no deployed drives in a cell that was not driven live, got some")
        return self

    @property
    def name(self) -> str:
        """Name of the cell and of its file."""
        return cell_name(self.scenario, self.victim, self.method, self.seed)

    @property
    def key(self) -> tuple[str, str, str]:
        """Scenario, victim and method: the cells of a table row, over seeds."""
        return self.scenario, self.victim, self.method

    @property
    def ticks(self) -> int:
        """Control ticks of a drive; 0 in cells from before they were stored."""
        return int(self.extra.get("horizon") or 0)

    def drives(self, domain: Domain) -> Drives | None:
        """The drives in a domain; None without any."""
        return self.surrogate if domain == "surrogate" else self.deployed

    def obstacles(self, domain: Domain) -> list[str | None]:
        """Obstacle that each drive in a domain hit; None for drives without a collision."""
        if kept := self.kept.get(domain):
            return [drive.obstacle for drive in kept]
        driven = self.drives(domain)
        blocked = self.extra.get("blocked_tick") if domain == "deployed" else None
        ticks = blocked or [None] * len(driven.total_cte_m if driven else ())
        return [None if tick is None else "obstacle" for tick in ticks]


def cell_name(scenario: str, victim: str, method: str, seed: int) -> str:
    """Name of a cell, e.g. ``straight_hardened_gradient_0``."""
    return f"{scenario}_{victim}_{method}_{seed}"


def cell_from(data: Any, source: str) -> CellResult:
    """A cell from JSON values; ``source`` names it in errors."""
    try:
        return CellResult.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise CellError(
            f"{source}: not a cell: {where}: {first['msg']}; remove it to run the cell again"
        ) from None


def read_cell(path: Path) -> CellResult:
    """Read one cell's file.

    Raises:
        CellError: The file is missing, not JSON, or not a cell.
    """
    try:
        data = read_json(path)
    except (OSError, ValueError) as error:
        raise CellError(f"{path}: cannot be read: {error}; remove it to run the cell again") from None
    return cell_from(data, str(path))


def read_cells(folder: Path) -> list[CellResult]:
    """All cells of a folder, in the order of their names."""
    return [read_cell(path) for path in sorted(folder.glob("*.json"))]
