"""A registration: what will be run, and which tests will be claimed, written before anything is run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Path
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_json
from advnerf_core.report.cells import cell_name
from advnerf_core.report.reference import Domain
from advnerf_core.strict import StrictModel

FORMAT: Literal["advnerf-registration-1"] = "advnerf-registration-1"
# In the folder of the published cells: what was registered, and which scenarios of it were given up later.
FILE, WITHDRAWN = "set/registration.json", "set/withdrawn.json"
Pose = tuple[float, float, float]
Share = Annotated[float, Field(gt=0, lt=1)]


class RegistrationError(AdvnerfError, ValueError):
    """A registration is not usable, or would come too late."""


class RegisteredScenario(StrictModel):
    """One scenario, or one placement of its objects.

    Attributes:
        settings_sha256: Hash of the world and of all settings that a result depends on.
        settings: The same in full, those that are left at their defaults too; empty in registrations from before it was kept.
        path: The reference path, as `Path.to_dict` writes it.
        ticks: Control ticks of a drive.
        dt_s: Length of a tick [s].
        off_track_m: |CTE| beyond which the car is off the track [m].
        held_cap_m: Largest |CTE| that a stopped car is charged per tick [m].
        starts: Start poses that are measured: x [m], y [m], yaw [rad]; no search has them.
        deployed_starts: How many of them, the first ones, are deployed.
        evaluations: Closed-loop drives of each search.
        space: What a search may change.
        victims: Recipe of the victims: teacher, data, optimiser steps, network.
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
        """What is summed, and the limits."""
        return Horizon(self.ticks, self.dt_s, self.off_track_m, self.held_cap_m)

    def reference_path(self) -> Path:
        """The path as an object."""
        return Path.from_dict(self.path)


class RegisteredCell(StrictModel):
    """One cell.

    Attributes:
        scenario: Name of the scenario.
        placement: Name of the placement; empty for the scenario's own.
        victim: Which policy.
        method: Which search, or ``none``.
        seed: Of the search.
    """

    scenario: str
    placement: str = ""
    victim: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the cell, and of its file."""
        return cell_name(self.scenario, self.victim, self.method, self.seed, self.placement)


class PrimaryTest(StrictModel):
    """A test that is claimed: the method's deployed excess against that of the baseline that is strongest in the surrogate.

    Attributes:
        scenario: Name of the scenario.
        placement: Name of the placement.
        victim: Which policy.
        method: Which search.
        against: The baselines.
    """

    scenario: str
    placement: str = ""
    victim: str
    method: str
    against: tuple[str, ...] = Field(min_length=1)


class Contrast(StrictModel):
    """Two conditions that the same attacks are driven under, and what differs between them.

    Attributes:
        name: What differs, for readers.
        before: A scenario.
        after: Another scenario of the same attacks, or the same one.
        before_in: Which of its drives.
        after_in: Which of its drives.
    """

    name: str = Field(min_length=1)
    before: str
    after: str
    before_in: Domain = "deployed"
    after_in: Domain = "deployed"


class Registration(StrictModel):
    """What will be run.

    Attributes:
        format: Of the file.
        name: Name of the set of results.
        file: The experiment file; `launch_file` says what it is called now.
        setting: Its setting.
        overrides: Changes of it on the command line.
        date: When it was registered, ISO.
        software_version: Of advnerf.
        scenarios: By name, ``NAME`` or ``NAME.PLACEMENT``.
        cells: All cells.
        primary: The tests that are claimed; Holm's adjustment is over these.
        contrasts: What is told apart by the same attacks under other conditions.
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
    level: Share = 0.95
    alpha: Share = 0.05

    def scenario(self, name: str, placement: str = "") -> RegisteredScenario | None:
        """A scenario; None if it is not registered."""
        return self.scenarios.get(scenario_key(name, placement))

    def as_filed(self) -> Registration:
        """The registration as `read_registration` reads it once it is written: its defaults are said."""
        return Registration.model_validate(self.model_dump(mode="json"))

    @property
    def digest(self) -> str:
        """SHA-256 of everything that its file says but its date; what was added to the format later is not in older files."""
        data = self.model_dump(mode="json", exclude={"date"}, exclude_unset=True)
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def launch_file(text: str) -> str:
    """A registered file, or a recorded command, with the name that the file has now: registrations and rows keep the old one."""
    return text.replace(".campaign.yaml", ".experiment.yaml")


def scenario_key(name: str, placement: str) -> str:
    """How a registration names a scenario with a placement."""
    return f"{name}.{placement}" if placement else name


def read_registration(folder: FilePath) -> Registration | None:
    """The registration in the folder of a set of results; None if there is none.

    Raises:
        RegistrationError: The file is not a registration's.
    """
    file = folder / FILE
    if not file.exists():
        return None
    try:
        return Registration.model_validate(read_json(file))
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        text = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise RegistrationError(
            f"{file}: expected a registration, got: {text}; restore it from git"
        ) from None


def read_withdrawn(folder: FilePath) -> dict[str, str]:
    """Registered scenarios of a set that were given up, each with the reason; empty without any.

    Raises:
        RegistrationError: The file does not say so.
    """
    return read_reasons(folder / WITHDRAWN, "withdrawn scenarios")


def read_reasons(file: FilePath, what: str) -> dict[str, str]:
    """Things of a set, each with a reason; empty without the file.

    Args:
        file: In the folder of a set.
        what: They are, for messages: ``withdrawn scenarios``.

    Raises:
        RegistrationError: The file does not say so.
    """
    if not file.exists():
        return {}
    try:
        found = read_json(file)
        if not all(isinstance(each, str) and each.strip() for pair in found.items() for each in pair):
            raise ValueError("expected a reason for each")
    except (OSError, ValueError, AttributeError) as error:
        raise RegistrationError(
            f"{file}: expected {what} with their reasons: {error}; restore it from git"
        ) from None
    return dict(found)


def withdraw(folder: FilePath, scenarios: Mapping[str, str]) -> None:
    """Give registered scenarios up, for reasons that the page of results tells.

    Raises:
        RegistrationError: One was not registered, has no reason, or has results already: these are published, whatever they say.
    """
    registration = read_registration(folder)
    if registration is None:
        raise RegistrationError(f"{folder}: expected {FILE}, which advnerf register writes, got none")
    names = {cell.scenario for cell in registration.cells}
    for scenario, reason in scenarios.items():
        if scenario not in names:
            raise RegistrationError(
                f"expected a registered scenario to withdraw ({', '.join(sorted(names))}), got {scenario!r}"
            )
        if not reason.strip():
            raise RegistrationError(f"expected a reason for withdrawing {scenario}; give {scenario}=REASON")
        there = [
            cell.name
            for cell in registration.cells
            if cell.scenario == scenario and (folder / f"{cell.name}.json").exists()
        ]
        if there:
            raise RegistrationError(
                f"{scenario} cannot be withdrawn, as {there[0]} was published; publish all of it"
            )
    write_json(folder / WITHDRAWN, {**read_withdrawn(folder), **scenarios})
