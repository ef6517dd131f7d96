"""A registration: the planned cells and the tests to be claimed, written before anything is run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Path
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_json
from advnerf_core.report.cells import cell_name
from advnerf_core.report.reference import Domain
from advnerf_core.strict import StrictModel

FORMAT: Literal["advnerf-registration-1"] = "advnerf-registration-1"
# In the folder of the published cells: the registration, and its scenarios that were withdrawn later.
FILE, WITHDRAWN = "set/registration.json", "set/withdrawn.json"
Pose = tuple[float, float, float]
Share = Annotated[float, Field(gt=0, lt=1)]
# Of a claim over places; of one over victims at one place, where fewer say little about the next victim.
_FEWEST_PLACES, _FEWEST_VICTIMS = 4, 5


class SetError(AdvnerfError, ValueError):
    """A set of results, its registration or another of its files is not usable, or would come too late."""


class RegisteredScenario(StrictModel):
    """One scenario.

    Attributes:
        settings_sha256: Hash of the world and of all settings that a result depends on.
        settings: All of these settings, including defaults; empty in registrations from before they were stored. Also ``files``, the SHA-256 of each
            object file, and ``methods``, the digest of each method of the user's own, if there are any: these are not in the hash.
        path: The reference path, as written by `Path.to_dict`.
        ticks: Control ticks of a drive.
        dt_s: Length of a tick [s].
        off_track_m: |CTE| beyond which the car is off the track [m].
        held_cap_m: Largest |CTE| that a stopped car is charged per tick [m].
        starts: Measured start poses: x [m], y [m], yaw [rad]; no search uses them.
        deployed_starts: Number of starts, from the first, that are deployed.
        evaluations: Closed-loop drives of each search.
        space: Name of the search space.
        victims: Recipe of the victims: teacher, data, optimiser steps, network; under ``policies`` the content hashes of existing ones.
        drives_well_mean_cte_m: A victim drives well if its mean |CTE| without attack is at most this [m], and it never leaves the track.
    """

    settings_sha256: str
    settings: dict[str, Any] = Field(default_factory=dict)
    path: dict[str, Any]
    ticks: Annotated[int, Field(ge=1)]
    dt_s: float
    off_track_m: float
    held_cap_m: float
    starts: tuple[Pose, ...] = Field(min_length=1)
    deployed_starts: Annotated[int, Field(ge=0)]
    evaluations: Annotated[int, Field(ge=1)]
    space: dict[str, Any]
    victims: dict[str, Any]
    drives_well_mean_cte_m: float

    @field_validator("path")
    @classmethod
    def _is_a_path(cls, path: dict[str, Any]) -> dict[str, Any]:
        try:
            Path.from_dict(path)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"expected a path as Path.to_dict writes it, got {error!r}") from None
        return path

    @property
    def horizon(self) -> Horizon:
        """Horizon of the sums, and the limits."""
        return Horizon(self.ticks, self.dt_s, self.off_track_m, self.held_cap_m)

    def pinned(self, victim: str, method: str) -> dict[str, Any]:
        """What a cell must have been run with, under the keys of its settings: object files, the code of its method, and its existing policy.

        Only what was registered is there: built-in methods, trained victims and older registrations lack it.
        """
        found = {
            "files": self.settings.get("files"),
            "code": self.settings.get("methods", {}).get(method),
            "policy_sha256": self.victims.get("policies", {}).get(victim),
        }
        return {name: each for name, each in found.items() if each is not None}

    def reference_path(self) -> Path:
        """The path as an object."""
        return Path.from_dict(self.path)


class RegisteredCell(StrictModel):
    """One cell; the method may be ``none``. The placement is in files from when the places of objects had names."""

    scenario: str
    placement: Literal[""] = ""
    victim: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the cell, and of its file."""
        return cell_name(self.scenario, self.victim, self.method, self.seed)


class PrimaryTest(StrictModel):
    """A claimed test: the method's deployed excess against that of the baseline, one of ``against``, that is strongest in the surrogate."""

    scenario: str
    placement: Literal[""] = Field(default="", description="As in `RegisteredCell`.")
    victim: str
    method: str
    against: tuple[str, ...] = Field(min_length=1)


class Contrast(StrictModel):
    """Two conditions for the same attacks, and the difference between them.

    Attributes:
        name: The difference, for readers.
        before: Name of a scenario.
        after: Another scenario of the same attacks, or the same one.
    """

    name: str = Field(min_length=1)
    before: str
    after: str
    before_in: Domain = "deployed"
    after_in: Domain = "deployed"

    @model_validator(mode="after")
    def _of_two(self) -> Contrast:
        if (self.before, self.before_in) == (self.after, self.after_in):
            raise ValueError(f"expected two conditions, got {self.before} {self.before_in} twice")
        return self


class PlaceClaim(StrictModel):
    """A claim about a kind of place or of victim: a method's deployed effect against that of the baseline that is strongest in the surrogate.

    Attributes:
        name: What is claimed about, for readers.
        scenarios: The places, drawn by a rule before any attack: four or more; or one, for a claim about victims, five or more.
        victims: The victims, each of which was driven at all places; of one recipe if the claim is about places.
    """

    name: str = Field(min_length=1)
    scenarios: tuple[str, ...] = Field(min_length=1)
    victims: tuple[str, ...] = Field(min_length=2)
    method: str = "gradient"
    against: tuple[str, ...] = Field(min_length=1)

    @field_validator("scenarios", "victims", "against")
    @classmethod
    def _different(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError(f"expected different ones, got {', '.join(names)}")
        return names

    @model_validator(mode="after")
    def _samples_enough(self) -> PlaceClaim:
        places, victims = len(self.scenarios), len(self.victims)
        if places < _FEWEST_PLACES and not (places == 1 and victims >= _FEWEST_VICTIMS):
            raise ValueError(
                f"expected {_FEWEST_PLACES} scenarios or more, or one and {_FEWEST_VICTIMS} victims or more, got {places} and {victims}"
            )
        return self


class Registration(StrictModel):
    """The planned cells and tests of a set.

    Attributes:
        file: The experiment file; `launch_file` gives its current name.
        date: Date of the registration, ISO.
        scenarios: Scenarios by name, ``NAME`` or ``NAME.PLACEMENT``.
        primary: The claimed tests; Holm's adjustment is over these.
        contrasts: Comparisons of the same attacks under two conditions.
        claims: Claims about kinds of places.
        level: Coverage of all intervals.
        alpha: Level of the tests.
    """

    format: Literal["advnerf-registration-1"] = FORMAT
    name: str
    file: str
    setting: str
    overrides: tuple[str, ...] = ()
    date: str
    software_version: str
    scenarios: dict[str, RegisteredScenario]
    cells: tuple[RegisteredCell, ...]
    primary: tuple[PrimaryTest, ...] = ()
    contrasts: tuple[Contrast, ...] = ()
    claims: tuple[PlaceClaim, ...] = ()
    level: Share = 0.95
    alpha: Share = 0.05

    def as_filed(self) -> Registration:
        """The registration as `read_registration` would read it from its file, with explicit defaults."""
        return Registration.model_validate(self.model_dump(mode="json"))

    @property
    def digest(self) -> str:
        """SHA-256 of the file's content except its date; keys that were added to the format later are not in older files."""
        left_out = {"date"} if self.claims else {"date", "claims"}
        data = self.model_dump(mode="json", exclude=left_out, exclude_unset=True)
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def launch_file(text: str) -> str:
    """A registered file, or a recorded command, with the file's current name: registrations and rows keep the old one."""
    return text.replace(".campaign.yaml", ".experiment.yaml")


def registered_file(text: str) -> FilePath:
    """The experiment file of a registration, which keeps its name alone: in ``launch`` of the working folder, else in that folder itself."""
    name = launch_file(text)
    inside = FilePath("launch") / name
    return inside if inside.is_file() else FilePath(name)


def settings_differences(
    registered: Mapping[str, Any], found: Mapping[str, Any], above: str = ""
) -> list[str]:
    """The settings that differ, each with its dotted key and both values; keys that only one of them has are newer than the other."""
    differ = []
    for name in sorted(registered.keys() & found.keys()):
        then, now = registered[name], found[name]
        if isinstance(then, dict) and isinstance(now, dict):
            differ += settings_differences(then, now, f"{above}{name}.")
        elif then != now:
            differ.append(f"{above}{name} {now!r:.40} instead of {then!r:.40}")
    return differ


def read_registration(folder: FilePath) -> Registration | None:
    """The registration in the folder of a set of results; None without one.

    Raises:
        SetError: The file is not a registration.
    """
    file = folder / FILE
    if not file.exists():
        return None
    try:
        return Registration.model_validate(read_json(file))
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        text = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise SetError(f"{file}: expected a registration, got: {text}; restore it from git") from None


def read_withdrawn(folder: FilePath) -> dict[str, str]:
    """Withdrawn scenarios of a set, each with the reason; empty without any.

    Raises:
        SetError: The file is invalid.
    """
    return read_reasons(folder / WITHDRAWN, "withdrawn scenarios")


def read_reasons(file: FilePath, what: str) -> dict[str, str]:
    """Reasons by name, from a file of a set; empty without the file.

    Raises:
        SetError: The file is invalid; the message calls the names ``what``.
    """
    if not file.exists():
        return {}
    try:
        found = read_json(file)
        if not all(isinstance(each, str) and each.strip() for pair in found.items() for each in pair):
            raise ValueError("expected a reason for each")
    except (OSError, ValueError, AttributeError) as error:
        raise SetError(f"{file}: expected {what} with their reasons: {error}; restore it from git") from None
    return dict(found)


def require_registration(folder: FilePath) -> Registration:
    """The registration in the folder of a set.

    Raises:
        SetError: There is none, or it is damaged.
    """
    registration = read_registration(folder)
    if registration is None:
        raise SetError(f"{folder}: expected {FILE}, which advnerf experiment register writes, got none")
    return registration


def require_registered(folder: FilePath, finished: Mapping[str, str]) -> None:
    """Refuse finished cells that were registered, and not run under this registration.

    Args:
        folder: Of the published set.
        finished: Digest of the registration that each cell was run under, by its name; empty for none.

    Raises:
        SetError: There is such a cell.
    """
    registration = require_registration(folder)
    names = {cell.name for cell in registration.cells}
    if others := [
        name for name, digest in finished.items() if name in names and digest != registration.digest
    ]:
        raise SetError(
            f"{folder}: expected cells that were run under the registration there, got {others[0]}{f' and {len(others) - 1} more' * (len(others) > 1)} "
            "run without it or under another one; register first, and run in a new run folder"
        )


def withdraw(folder: FilePath, scenarios: Mapping[str, str], finished: Collection[str] = ()) -> None:
    """Withdraw registered scenarios, with reasons that the page of results shows.

    Args:
        finished: Names of cells that are finished and not published yet.

    Raises:
        SetError: A scenario was not registered, has no reason, or already has results: these are published, good or bad.
    """
    registration = require_registration(folder)
    names = {cell.scenario for cell in registration.cells}
    for scenario, reason in scenarios.items():
        if scenario not in names:
            raise SetError(
                f"expected a registered scenario to withdraw ({', '.join(sorted(names))}), got {scenario!r}"
            )
        if not reason.strip():
            raise SetError(f"expected a reason for withdrawing {scenario}; give {scenario}=REASON")
        there = [
            cell.name
            for cell in registration.cells
            if cell.scenario == scenario
            and (cell.name in finished or (folder / f"{cell.name}.json").exists())
        ]
        if there:
            how = "is finished" if there[0] in finished else "was published"
            raise SetError(f"{scenario} cannot be withdrawn, as {there[0]} {how}; publish all of it")
    write_json(folder / WITHDRAWN, {**read_withdrawn(folder), **scenarios})
