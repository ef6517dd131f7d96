"""Decisions of an audit, stored in its folder, so that a resumed run does not decide again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from advnerf_core.documents import Document, read_json
from advnerf_core.files import write_json
from advnerf_core.strict import StrictModel, validate
from nodes.audit.question import AuditedQuestion, experiment_data, setting_of, write_experiment
from nodes.audit.spots import Spot
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.plan.placed import PlacedObject
from nodes.runtime.errors import ConfigError

FILE = "plan.json"


class Decided(StrictModel):
    """Content of the decisions' file.

    Attributes:
        evaluations: Evaluations that the budget buys; None before they were counted.
        minutes: The budget that bought them, in minutes; None if their number itself was asked for.
        spots: Possible places of the object; None before they were chosen.
        spots_in: Hash of the learned place that they were chosen in; empty before they were chosen.
        settings: Settings of the experiment file, by name.
    """

    question: str
    evaluations: int | None = Field(default=None, ge=1)
    minutes: float | None = Field(default=None, gt=0.0)
    spots: list[dict[str, Any]] | None = None
    spots_in: str = ""
    settings: dict[str, dict[str, Any]] = Field(default_factory=dict)


@dataclass
class AuditPlan:
    """The decisions of one audit in its folder; a planted victim may be added to its question."""

    folder: Path
    question: AuditedQuestion
    decided: Decided

    @classmethod
    def of(cls, folder: Path, question: AuditedQuestion) -> AuditPlan:
        """The decisions in a folder, or empty ones: those about another question count only once something was decided.

        Raises:
            ConfigError: The folder belongs to another audit.
        """
        key, file = (
            hash_of([experiment_data(question), list(question.overrides), question.kind, question.size_m]),
            folder / FILE,
        )
        if not file.exists():
            return cls(folder, question, Decided(question=key))
        decided = validate(Decided, Document(read_json(file), str(file)))
        if decided.question != key and decided == Decided(question=decided.question):
            return cls(folder, question, Decided(question=key))
        if decided.question != key:
            raise ConfigError(
                f"expected a folder of this audit or a new one, got {folder}, where another policy, place, lane, car or object was asked about; name "
                "another one with --output"
            )
        return cls(folder, question, decided)

    def agreed(self, minutes: float | None, evaluations: int | None) -> tuple[float | None, int | None]:
        """Minutes or evaluations of this audit: as its searches were planned, or as asked now.

        Raises:
            ConfigError: Its searches were planned with another budget than is asked for.
        """
        planned = self.decided.minutes, self.decided.evaluations
        if planned[1] is None:
            return minutes, evaluations
        if (minutes is not None and minutes != planned[0]) or (
            evaluations is not None and (planned[0] is not None or evaluations != planned[1])
        ):
            bought = (
                f"{planned[1]} evaluations"
                if planned[0] is None
                else f"{planned[0]:g} min ({planned[1]} evaluations)"
            )
            raise ConfigError(
                f"expected the budget that the searches in {self.folder} were planned with, {bought}; leave --budget and --evaluations out to go on "
                "with it, or name another folder with --output"
            )
        return planned[0], planned[1]

    def spots(self, place: str) -> list[Spot] | None:
        """Possible places of the object; None before they were chosen in the learned place of this hash."""
        if self.decided.spots is None or self.decided.spots_in != place:
            return None
        return [
            Spot(**{**each, "placed": PlacedObject.model_validate(each["placed"])})
            for each in self.decided.spots
        ]

    def choose(self, spots: list[Spot], place: str) -> None:
        """Store the possible places of the object, and the hash of the learned place that they were chosen in."""
        self.decide(spots=[{**vars(each), "placed": as_listed(each)} for each in spots], spots_in=place)

    def add(self, setting: str, objects: list[dict[str, Any]], **sections: Any) -> None:
        """Add a setting with an object to the experiment file."""
        values = setting_of(self.question, objects, **sections)
        self.decide(settings={**self.decided.settings, setting: values})

    def decide(self, **values: Any) -> None:
        """Store decisions by their names in `Decided`."""
        self.decided = self.decided.model_copy(update=values)
        self.save()

    def save(self) -> Path:
        """Write the decisions, and the experiment file, whose path is returned."""
        write_json(self.folder / FILE, self.decided.model_dump(mode="json"))
        return write_experiment(self.folder, self.question, self.decided.settings)


def as_listed(spot: Spot) -> dict[str, Any]:
    """An object at a spot in the form of experiment files; a file with its absolute path."""
    return {**spot.placed.model_dump(mode="json", exclude_defaults=True), "kind": spot.placed.kind}
