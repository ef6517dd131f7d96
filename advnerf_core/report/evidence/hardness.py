"""Whether a victim withstands random textures: the worst of N of each validation family, judged before any gradient runs against it.

A victim that was trained with textures is called *hardened* only with a passing verdict of exactly its policy, recorded in every gradient search
against it. `victim_title` decides its name on pages.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, ValidationError, model_validator

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_json
from advnerf_core.report.cells import CellResult, read_cell
from advnerf_core.strict import StrictModel

FORMAT: Literal["advnerf-hardness-1"] = "advnerf-hardness-1"
# In a run folder; for a published set in its folder ``set``.
FILE, PUBLISHED_FILE = "hardness.json", "set/hardness.json"
MOST_RECIPES = 3
HARDENED, TRAINED_WITH_TEXTURES = "hardened", "trained with textures"
LEVEL = 0.95
Metres = Annotated[float, Field(allow_inf_nan=False)]


class HardnessError(AdvnerfError, ValueError):
    """A verdict cannot be read, or must not be made."""


class FamilyHardness(StrictModel):
    """One victim with N random textures of one family, in the surrogate.

    Attributes:
        scenario: Name of the path.
        family: Method that draws the textures.
        excess_m: Excess |CTE| per tick of each texture, mean over the starts [m].
        upper_m: One-sided upper bound of the worst texture's mean over starts [m]; None with a single start.
    """

    scenario: str
    family: str
    excess_m: tuple[Metres, ...] = Field(min_length=1)
    upper_m: Metres | None

    @classmethod
    def of(cls, scenario: str, family: str, excess_m: ArrayLike, level: float = LEVEL) -> FamilyHardness:
        """Compute from the excess |CTE| per tick of every texture and start ``[N, S]`` [m].

        The bound of ``level`` is Student's t over the starts of the texture with the largest mean.
        """
        from scipy.special import stdtrit  # reading verdicts needs no SciPy

        values = np.asarray(excess_m, np.float64)
        means = values.mean(axis=1)
        worst, starts = values[means.argmax()], values.shape[1]
        upper_m = None
        if starts > 1:
            margin = stdtrit(starts - 1, level) * worst.std(ddof=1) / np.sqrt(starts)
            upper_m = float(worst.mean() + margin)
        return cls(scenario=scenario, family=family, excess_m=tuple(map(float, means)), upper_m=upper_m)

    @property
    def worst_m(self) -> float:
        """Excess of the worst texture, mean over its starts [m]."""
        return max(self.excess_m)


class HardnessVerdict(StrictModel):
    """Effect of N textures of each validation family on one policy.

    Attributes:
        policy_sha256: Content hash of its policy.
        recipe: Training settings of the victim.
        trained_on: Families of its training.
        validated_on: Families that judge it; the baselines of the tests are others.
        textures: Textures of each family, N.
        seed: Seed of the textures.
        starts: Measured starts of each texture.
        margin_m: Largest excess of the worst texture that counts as no effect [m per tick].
        level: Level of the one-sided bounds.
        families: Results, per scenario and family.
    """

    victim: str
    policy_sha256: str
    recipe: dict[str, Any]
    trained_on: tuple[str, ...] = Field(min_length=1)
    validated_on: tuple[str, ...] = Field(min_length=1)
    textures: Annotated[int, Field(ge=1)]
    seed: int
    starts: Annotated[int, Field(ge=1)]
    margin_m: Metres
    level: Annotated[float, Field(gt=0, lt=1)] = LEVEL
    families: tuple[FamilyHardness, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _disjoint_and_complete(self) -> HardnessVerdict:
        if both := sorted({*self.trained_on} & {*self.validated_on}):
            raise ValueError(
                f"expected other families to validate than to train, got {', '.join(both)} in both"
            )
        if {each.family for each in self.families} != {*self.validated_on}:
            raise ValueError(f"expected results of {', '.join(self.validated_on)} and no others")
        if any(len(each.excess_m) != self.textures for each in self.families):
            raise ValueError(f"expected {self.textures} textures of each family, got another number")
        return self

    @property
    def passed(self) -> bool:
        """Whether the bound of every family's worst texture is within the margin, in every scenario."""
        bounds = [each.upper_m for each in self.families]
        return all(bound is not None and bound <= self.margin_m for bound in bounds)

    @property
    def digest(self) -> str:
        """SHA-256 of its content."""
        return hashlib.sha256(json.dumps(self.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()


class HardnessRecord(StrictModel):
    """All verdicts of one victim's recipes, oldest first; at most three recipes."""

    format: Literal["advnerf-hardness-1"] = FORMAT
    verdicts: tuple[HardnessVerdict, ...] = ()

    def with_verdict(self, verdict: HardnessVerdict) -> HardnessRecord:
        """The record with one more verdict; a repeated one changes nothing.

        Raises:
            HardnessError: The policy has another verdict, or three other recipes were tried.
        """
        known = [each for each in self.verdicts if each.policy_sha256 == verdict.policy_sha256]
        if known and known[0].digest == verdict.digest:
            return self
        if known:
            raise HardnessError(
                f"expected one verdict of policy {verdict.policy_sha256[:12]}, got another: a victim is not judged until it passes; "
                "keep the first, or train by another recipe"
            )
        recipes = {json.dumps(each.recipe, sort_keys=True) for each in (*self.verdicts, verdict)}
        if len(recipes) > MOST_RECIPES:
            raise HardnessError(
                f"expected at most {MOST_RECIPES} recipes of one victim, got {len(recipes)}; keep what there is: it is called "
                f"{TRAINED_WITH_TEXTURES}"
            )
        return HardnessRecord(verdicts=(*self.verdicts, verdict))

    def passing(self, policy_sha256: str) -> HardnessVerdict | None:
        """The passing verdict of a policy; None without one."""
        return next((v for v in self.verdicts if v.passed and v.policy_sha256 == policy_sha256), None)


def read_hardness(file: Path) -> HardnessRecord:
    """The verdicts in a file; an empty record without a file.

    Raises:
        HardnessError: The file is not a record of verdicts.
    """
    if not file.exists():
        return HardnessRecord()
    try:
        return HardnessRecord.model_validate(read_json(file))
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        text = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise HardnessError(
            f"{file}: expected verdicts of python -m benchmarks.hardening, got: {text}; remove it and judge the victim again"
        ) from None


def write_hardness(file: Path, record: HardnessRecord) -> None:
    """Write a record of verdicts."""
    write_json(file, record.model_dump(mode="json"))


def merged(records: Iterable[HardnessRecord]) -> HardnessRecord:
    """One record of all verdicts.

    Raises:
        HardnessError: See `HardnessRecord.with_verdict`.
    """
    found = HardnessRecord()
    for verdict in (each for record in records for each in record.verdicts):
        found = found.with_verdict(verdict)
    return found


def victim_title(
    victim: str, cells: Iterable[CellResult], record: HardnessRecord, baselines: Collection[str] = ()
) -> str:
    """Name of a victim on pages, which may differ from the ``hardened`` of files and keys.

    Cells are read only if a verdict passed. A verdict on one of the ``baselines`` that the set's tests compare with does not count.
    """
    if victim != HARDENED:
        return victim
    if not any(verdict.passed for verdict in record.verdicts):
        return TRAINED_WITH_TEXTURES
    searched = [cell for cell in cells if cell.victim == victim and cell.method.startswith("gradient")]
    judged = bool(searched) and all(_judged_before(cell, record, baselines) for cell in searched)
    return HARDENED if judged else TRAINED_WITH_TEXTURES


def titles_of(folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Names of a set's victims on pages, by their names in files; ``data`` is the content of its ``set.json``."""
    record = read_hardness(folder / PUBLISHED_FILE)
    baselines = {name for test in data["primary"] for name in test["test"]["against"]}
    names = {row["victim"] for row in data["rows"]}

    def title(name: str) -> str:
        return victim_title(name, map(read_cell, sorted(folder.glob("*.json"))), record, baselines)

    return {name: title(name) for name in sorted(names)}


def with_titles(folder: Path, data: Mapping[str, Any]) -> dict[str, Any]:
    """The published numbers of a set, the content of its ``set.json``, with its victims' names on pages."""
    titles = titles_of(folder, data)

    def titled(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {k: titles.get(v, v) if k == "victim" else titled(v) for k, v in value.items()}
        return [titled(each) for each in value] if isinstance(value, list) else value

    found: dict[str, Any] = titled(data)
    return found


def _judged_before(cell: CellResult, record: HardnessRecord, baselines: Collection[str]) -> bool:
    """Whether a passing verdict of the cell's policy, on other families than the baselines, existed before its search began."""
    verdict = record.passing(cell.policy_sha256)
    if verdict is None or cell.extra.get("hardness") != verdict.digest:
        return False
    return not {*verdict.trained_on, *verdict.validated_on} & {*baselines}
