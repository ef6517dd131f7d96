"""The resolved question of an audit: the policy, the place and the object; and its experiment file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from advnerf_core.documents import dump_yaml
from advnerf_core.files import write_atomically
from advnerf_core.report.audit_result import Evidence, PlaceKind, Scale
from nodes.experiment.plan.object_kinds import PANEL

VICTIM, PLANTED, OBJECT = "policy", "planted", "object"
FILE = "audit.experiment.yaml"
# Searches draw their starts from their own seeds, counted from 0; selection and judging use none of these.
SELECTION_SEED, JUDGING_SEED = 10_000, 20_000
SELECTION_STARTS = 4
HALF, OTHER_HALF = "half", "other-half"
# The teacher of the exported steering returns to the path within about this many half lanes.
RETURNS_IN = 5.0
# A small audit: fewer pictures would fail the fidelity gate, so the searches are shortened instead.
CI_SECTIONS: Mapping[str, Any] = {"scene": {"steps": 600}}


@dataclass(frozen=True)
class Place:
    """The place of the audit.

    Attributes:
        name: Name in sentences.
        world: The section ``world`` of the experiment.
        base: Experiment file whose settings fit the place; None for the defaults.
        path: Name of the driven path of the world.
        shows_panels: Whether the world's own renderer shows panels.
        held_out: Number of held-out photographs, of a place with few; None for the default.
    """

    name: str
    kind: PlaceKind
    source: str
    scale: Scale
    world: Mapping[str, Any]
    base: Path | None = None
    path: str = ""
    shows_panels: bool = False
    held_out: int | None = None

    @property
    def is_driven(self) -> bool:
        """Whether the place is a world that can be driven; else it is known by photographs alone, from which two scenes are learned."""
        return self.kind == "world"

    @property
    def evidence(self) -> Evidence:
        """The strongest possible evidence."""
        return "world" if self.is_driven else "surrogate"


@dataclass(frozen=True)
class AuditedQuestion:
    """The question of an audit.

    Attributes:
        policy: Name of the policy for experiments.
        given: The user's name for it.
        limit_m: |CTE| beyond which the car has left its lane [m]; None uses the world's.
        kind: Kind of the object: ``panel``, or a file.
        size_m: Width of the object [m]; None for a share of the lane.
        judging: Number of starts for the verdict.
        sections: Sections of the experiment file besides place and victim.
    """

    policy: str
    given: str
    place: Place
    limit_m: float | None
    kind: str = PANEL
    size_m: float | None = None
    overrides: Sequence[str] = ()
    judging: int = 20
    sections: Mapping[str, Any] = field(default_factory=dict)


def experiment_data(question: AuditedQuestion) -> dict[str, Any]:
    """The experiment without an object, in the form of its file."""
    place = question.place
    own = {} if place.is_driven else _of_photographs(question)
    data: dict[str, Any] = {} if place.base is None else {"base": str(place.base)}
    data |= {
        "name": "audit",
        "world": dict(place.world),
        **({"paths": [place.path]} if place.path else {}),
        "objects": [],
        "victims": {VICTIM: {"policy": question.policy}},
        "carrier": {"kind": "composed"},
        "space": {"kind": "colours", "cells": 8},
        "deploy": {"through": "world" if place.is_driven else "nothing"},
        "scene": {"bake_unbounded": True},
        "measure": {"starts": SELECTION_STARTS, "seed": SELECTION_SEED, "scene": "baked"},
        "retrain": None,
        "reference": None,
        "gate": None,  # the audit judges the scene itself, and reports the result
    }
    return _merged(_merged(data, own), question.sections)


def _of_photographs(question: AuditedQuestion) -> dict[str, Any]:
    assert question.limit_m is not None, "photographs declare no lane"
    held_out = question.place.held_out
    return {
        **({} if held_out is None else {"capture": {"held_out": held_out}}),
        "held_cap_m": 4.0 * question.limit_m,
        "attack": {"start_sigma": min(0.1, 0.25 * question.limit_m)},
        "policy": {"stiffness_1pm": 1.0 / (RETURNS_IN * question.limit_m), "delay_s": 0.05},
    }


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        if isinstance(under, Mapping) and isinstance(value, Mapping):
            merged[key] = _merged(under, value)
        else:
            merged[key] = value
    return merged


def write_experiment(
    folder: Path, question: AuditedQuestion, settings: Mapping[str, Mapping[str, Any]]
) -> Path:
    """Write the experiment file: the place, the victim, and one setting for each search; ``advnerf experiment run`` can run it again."""
    text = dump_yaml(
        {**experiment_data(question), "settings": {"place": {}, **_of_halves(question), **settings}},
        default_flow_style=None,
        width=140,
    )
    head = "# Written by advnerf audit: each setting is one search; advnerf experiment run FILE --setting NAME --folder FOLDER runs it again.\n"
    file = folder / FILE
    write_atomically(file, head + text)
    return file


def _of_halves(question: AuditedQuestion) -> dict[str, Any]:
    """Settings that learn a place of photographs from one half of them."""
    if question.place.is_driven:
        return {}
    return {
        HALF: {"world": {"half": "even"}},
        OTHER_HALF: {"world": {"half": "odd"}, "scene": {"seed": 1}},
    }


def setting_of(
    question: AuditedQuestion, objects: Sequence[Mapping[str, Any]], **sections: Any
) -> dict[str, Any]:
    """A setting of the experiment file with an object; a world with native panels shows it in them, in its own light."""
    carrier = (
        {"carrier": {"kind": "native"}} if question.place.shows_panels and question.kind == PANEL else {}
    )
    return {"objects": [dict(each) for each in objects], **carrier, **sections}


def half_overrides(question: AuditedQuestion, setting: str) -> list[str]:
    """The overrides that apply the setting of one half to another setting."""
    of_half = _of_halves(question).get(setting, {})
    return [
        f"{section}.{key}={value}" for section, values in of_half.items() for key, value in values.items()
    ]
