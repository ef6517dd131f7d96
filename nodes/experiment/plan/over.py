"""The section ``over`` of an experiment: the dimensions of its cells, and its variants."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, Field, StringConstraints, model_validator

from advnerf_core.documents import Document, Key
from advnerf_core.plugins import name_in_results
from advnerf_core.report.conditions import NONE
from advnerf_core.strict import StrictModel
from nodes.experiment.plan.method_names import ConditionReference
from nodes.experiment.plan.numbers import Count
from nodes.experiment.plan.victims import VictimName

# Names become parts of file names, which are separated by "_" and "."; a variant may hold "_", victims may not.
VariantName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_-]*$")]
OVER, VARIANT = "over", "variant"
_MOST_VARIANTS = 10_000  # status and table read a file for each cell


class OverConfig(StrictModel):
    """Dimensions of an experiment: its cells are the product. Any other key of the experiment may be an axis too, as a dotted path
    with a list of values: ``attack.evaluations: [20, 60]``."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(init=False)

    variant: dict[VariantName, dict[str, Any]] = Field(
        default={},
        description="Named variants of the experiment: for each the keys that differ, as dotted paths. With base (and setting) a variant begins "
        "from another experiment file instead of this one; with run_folder it has stages of its own.",
    )
    path: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="Paths; none: all of the experiment's."
    )
    victim: tuple[VictimName, ...] | None = Field(
        default=None,
        min_length=1,
        description="Victims; none: all of the experiment's, the one that was trained without textures with the first seed alone.",
    )
    method: tuple[ConditionReference, ...] = Field(
        default=(NONE, "random", "cem", "gradient"),
        min_length=1,
        description="What victims meet: the controls none (the plain object) and empty (no object), and methods of attack; also file.py:Name, relative "
        "to the experiment file.",
    )
    seed: tuple[Count, ...] = Field(
        default=(0,), min_length=1, description="Seeds of the searches: one search of each method per seed."
    )

    @model_validator(mode="after")
    def _nothing_twice(self) -> OverConfig:
        for name in ("path", "victim", "method", "seed"):
            values = getattr(self, name) or ()
            # Two files may have methods of one name.
            names = [name_in_results(value) for value in values] if name == "method" else values
            if name == "method" and len(set(values)) == len(values) and len(set(names)) != len(names):
                raise ValueError(
                    f"expected methods of different names, as cells and files are called by them, got {', '.join(map(str, names))}; rename one in its file"
                )
            if len(set(names)) != len(names):
                raise ValueError(f"expected every one of over.{name} once, got {list(values)}")
        return self


# Keys that select the cells of a variant; all other keys of the section make variants.
COORDINATES = tuple(name for name in OverConfig.model_fields if name != VARIANT)


@dataclass(frozen=True)
class AxisChange:
    """One change of a variant.

    Attributes:
        key: The key of the experiment, as a dotted path.
        value: Value of the key in the variant.
        origin: Place of the value in the experiment file.
    """

    key: str
    value: Any
    origin: Key


def with_dotted_axes(document: Document) -> None:
    """Convert, in place, the sections that ``--set over.attack.evaluations=[20,60]`` makes in a section ``over`` to dotted paths."""
    over = document.data.get(OVER)
    for name in list(over) if isinstance(over, dict) else ():
        if name == VARIANT or not isinstance(over[name], dict):
            continue
        for key, value in _leaves(over.pop(name), (name,)):
            over[".".join(key)] = value
            document.places[(OVER, ".".join(key))] = document.place((OVER, *key))


def _leaves(values: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, (*above, str(name)))
        else:
            yield (*above, str(name)), value


def variants_in(over: Any) -> dict[str, list[AxisChange]]:
    """The variants of a section ``over`` by name, each with its changes: the product of its named variants and its axes.

    The section is not validated yet; its errors are reported there.

    Raises:
        ValueError: Two variants have one name, or there are too many.
    """
    if not isinstance(over, dict):
        return {}
    named, factors = (
        over.get(VARIANT),
        [_values(key, each) for key, each in over.items() if _is_axis(key, each)],
    )
    if isinstance(named, dict) and named:
        factors.insert(0, [(name, _changes(name, changes)) for name, changes in named.items()])
    if (count := math.prod(map(len, factors))) > _MOST_VARIANTS:
        raise ValueError(f"expected at most {_MOST_VARIANTS} variants, got {count}; make several files")
    found: dict[str, list[AxisChange]] = {}
    for combined in itertools.product(*factors) if factors else ():
        name = "_".join(str(each) for each, _ in combined)
        if name in found:
            raise ValueError(
                f"expected values whose letters and digits differ, got two variants of the name {name}"
            )
        found[name] = [change for _, changes in combined for change in changes]
    return found


def coordinates_in(over: Any) -> dict[str, Any]:
    """The part of a section ``over`` that selects the cells of a variant."""
    return {name: over[name] for name in COORDINATES if name in over} if isinstance(over, dict) else {}


def _changes(name: str, changes: Any) -> list[AxisChange]:
    """The changes of a named variant."""
    items = changes.items() if isinstance(changes, dict) else ()
    return [AxisChange(str(key), value, (OVER, VARIANT, name, key)) for key, value in items]


def _is_axis(key: str, values: Any) -> bool:
    return isinstance(values, list) and key != VARIANT and key not in COORDINATES


def _values(key: str, values: list[Any]) -> list[tuple[str, list[AxisChange]]]:
    """Names of an axis's values in the names of variants, and the change of each."""
    last = key.rpartition(".")[2]
    return [
        (f"{last}-{_slug(value, at)}", [AxisChange(key, value, (OVER, key, at))])
        for at, value in enumerate(values)
    ]


def _slug(value: Any, number: int) -> str:
    """A value in the name of a variant; for a section or a list its number in the axis."""
    letters = (
        "" if isinstance(value, dict | list) else re.sub(r"[^a-z0-9]+", "-", str(value).lower()).strip("-")
    )
    return letters or str(number)
