"""The base of all models that are read from files, and the conversion of a document to a typed object.

pydantic takes ``true`` for 1, ``"12"`` for 12 and ``1`` for ``true``. In a file, each of these is a mistake.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    Tag,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import CoreSchema, PydanticKnownError, SchemaValidator, core_schema

from advnerf_core.documents import Document, Key, raise_problems
from advnerf_core.errors import ConfigError
from advnerf_core.unit_bounds import MOST_LAG_S, MOST_LENGTH_M, MOST_SPEED_MPS

# Types of pydantic errors whose message includes the input.
COMPLETE = "complete"

M = TypeVar("M")
_DONE = "advnerf_strict"
_NOT_SCHEMAS = frozenset({"metadata", "default", "serialization", "expected", "config", "cls", "ref"})
# In pydantic's path of a wrong value: a tag of several words, a type with parameters, the name of a class.
_INSERTED = re.compile(r"[ \[]|^[A-Z][A-Za-z0-9]*[a-z][A-Za-z0-9]*$")
_DOTTED = re.compile(r"[a-z_]\w*(?:\.\w+)+")
# Types of pydantic errors that name a Python type, and what a file has instead.
_NOT_OF_YAML = {
    "tuple_type": "a list in brackets",
    "list_type": "a list in brackets",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "dataclass_type": "keys and values",
}
_DATES = frozenset({"date", "datetime", "time", "timedelta"})


class Strict:
    """Annotation that makes the numbers and booleans of a type strict, also inside its dataclasses, lists and unions."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Schema of the annotated type, changed in place."""
        schema = handler(source)
        _make_strict(schema, handler, set())
        return schema


def _make_strict(part: Any, handler: GetCoreSchemaHandler, seen: set[str]) -> None:
    if isinstance(part, list | tuple):
        for each in part:
            _make_strict(each, handler, seen)
    if not isinstance(part, dict) or (isinstance(part.get("metadata"), dict) and _DONE in part["metadata"]):
        return
    kind = part.get("type") if isinstance(part.get("type"), str) else None  # a field may have this name
    if kind == "definition-ref" and part["schema_ref"] not in seen:
        seen.add(part["schema_ref"])
        try:
            _make_strict(handler.resolve_ref_schema(part), handler, seen)
        except LookupError:  # a class that refers to itself; its own schema is being made
            return
    elif kind in ("float", "bool"):
        part["strict"] = True
    elif kind == "literal" and any(isinstance(each, int) for each in part["expected"]):
        _wrap(part, partial(_refuse_equal_type, part["expected"]))
    elif kind == "int" or kind in _DATES:
        # A strict integer would refuse 1e3, and a strict date its text.
        _wrap(part, _refuse_other_types if kind == "int" else _refuse_numbers)
    else:
        for name, value in part.items():
            if name not in _NOT_SCHEMAS:
                _make_strict(value, handler, seen)


def _wrap(part: Any, check: Callable[[Any], Any]) -> None:
    """Put a check before a schema, in place."""
    inner = {**part, "metadata": {**(part.get("metadata") or {}), _DONE: True}}
    part.clear()
    part.update(core_schema.no_info_before_validator_function(check, typing.cast("CoreSchema", inner)))


def _refuse_equal_type(expected: list[Any], value: Any) -> Any:
    """Reject ``true`` where 1 is a choice, since they are equal."""
    if isinstance(value, bool | int | float) and not any(type(value) is type(each) for each in expected):
        raise PydanticKnownError("literal_error", {"expected": " or ".join(map(repr, expected))})
    return value


def _refuse_other_types(value: Any) -> Any:
    if isinstance(value, bool | str | bytes):
        raise PydanticKnownError("int_type")
    return value


def _refuse_numbers(value: Any) -> Any:
    if isinstance(value, int | float):
        raise PydanticKnownError("string_type")
    return value


class StrictModel(BaseModel):
    """Base of models that are read from files: unknown keys, other types and numbers that are not finite are errors."""

    # Built when it is first used: a process uses a fraction of the models that it imports, and no node should start later for the others.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Schema of the class, in which numbers and booleans are strict."""
        return Strict().__get_pydantic_core_schema__(source, handler)


def at_most(largest: float, unit: str, mistaken: str) -> AfterValidator:
    """Check of a magnitude, wider than any honest value, that a number in another unit exceeds.

    Args:
        largest: The bound.
        unit: The number's unit.
        mistaken: Units that it was probably given in.
    """

    def check(value: float) -> float:
        if abs(value) > largest:
            raise ValueError(f"expected at most {largest:g} {unit}, not {mistaken}")
        return value

    return AfterValidator(check)


def within_a_turn(angle_rad: float) -> float:
    """The angle, or a `ValueError` if it is more than a turn, as degrees are."""
    if abs(angle_rad) > 2.0 * math.pi:
        raise ValueError(
            f"expected radians, at most a turn of 6.2832, got {angle_rad:g}; as degrees that is {math.radians(angle_rad):.4f}"
        )
    return angle_rad


Angle = Annotated[float, AfterValidator(within_a_turn)]
"""An angle [rad]; degrees are refused where they are more than a turn."""

LengthM = Annotated[float, at_most(MOST_LENGTH_M, "m", "cm or mm")]
SpeedMps = Annotated[float, at_most(MOST_SPEED_MPS, "m/s", "km/h or mm/s")]
RightAngleRad = Annotated[float, at_most(0.5 * math.pi, "rad", "degrees")]
AngularRate = Annotated[float, at_most(100.0, "rad/s", "degrees/s")]
LagS = Annotated[float, at_most(MOST_LAG_S, "s", "ms")]


def validate(model: type[M], document: Document, folder: Path | None = None) -> M:
    """Typed object of a document; all its unknown and invalid keys are one `ConfigError` with a line for each problem.

    Args:
        model: A pydantic model or a dataclass.
        document: The document to convert.
        folder: Folder that ``file.py:Name`` in it is relative to; the working folder if it is not given.
    """
    if not isinstance(document.data, dict):
        raise ConfigError(
            f"{document.place(())}: expected keys and values, got {type(document.data).__name__}"
        )
    raise_problems(list(_unknown_keys(model, document, ())))
    try:
        return typing.cast(
            M,
            strict_validator(model).validate_python(document.data, context={"folder": folder}),
        )
    except ValidationError as error:
        raise_problems(_explain(model, document, error))
        raise


def parse_value(annotation: Any, document: Document) -> Any:
    """Typed value of a document that is part of a bigger one, such as a section; errors as in `validate`."""
    try:
        return strict_validator(annotation).validate_python(document.data)
    except ValidationError as error:
        raise_problems(_explain(annotation, document, error))
        raise


def strict_validator(model: Any) -> SchemaValidator:
    """Validator of a model or type whose numbers and booleans are strict."""
    return _validator(model)


@lru_cache(maxsize=64)
def _validator(model: Any) -> SchemaValidator:
    adapter = TypeAdapter(Annotated[model, Strict()])
    adapter.rebuild()  # of a model that is not built yet
    schema = adapter.core_schema
    # pydantic takes over the validators of complete models. A plug-in's model that does not derive from StrictModel is not strict, nor
    # are those that hold it.
    found = set(_models_in(schema))
    others = set() if all(issubclass(each, StrictModel) for each in found) else found
    try:
        for each in others:
            each.__pydantic_complete__ = False
        return SchemaValidator(schema)
    finally:
        for each in others:
            each.__pydantic_complete__ = True


def _models_in(part: Any) -> Iterator[type[BaseModel]]:
    """Complete models in a core schema."""
    if isinstance(part, list | tuple):
        for each in part:
            yield from _models_in(each)
    elif isinstance(part, dict):
        if part.get("type") == "model" and part["cls"].__pydantic_complete__:
            yield part["cls"]
        for name, value in part.items():
            if name not in _NOT_SCHEMAS:
                yield from _models_in(value)


def is_of_settings(found: Any) -> bool:
    """Whether something is a class of settings: a pydantic model or a dataclass."""
    return isinstance(found, type) and (dataclasses.is_dataclass(found) or issubclass(found, BaseModel))


def _unknown_keys(model: Any, document: Document, key: Key) -> Iterator[str]:
    """Unknown keys of models that would ignore them: dataclasses, and pydantic models without a rule for extra keys."""
    data = document.data
    for step in key:
        data = data[step]
    silent = dataclasses.is_dataclass(model) or (
        isinstance(model, type) and issubclass(model, BaseModel) and "extra" not in model.model_config
    )
    if not silent or not isinstance(data, dict):
        return
    hints = _hints(model)
    for name in data:
        if name in hints:
            yield from _unknown_keys(hints[name], document, (*key, name))
            continue
        written = ".".join(map(str, (*key, name)))
        yield (
            f"{document.place((*key, name))}: unknown key {written}; valid keys here: {', '.join(sorted(hints)) or 'none'}"
        )


def _hints(model: Any) -> dict[str, Any]:
    """Fields of a model by their name in files; empty if it is not a model."""
    if isinstance(model, type) and issubclass(model, BaseModel):
        return {each.alias or name: each.annotation for name, each in model.model_fields.items()}
    if isinstance(model, type) and dataclasses.is_dataclass(model):
        known = typing.get_type_hints(model)
        return {each.name: known[each.name] for each in dataclasses.fields(model) if each.init}
    return {}


def _explain(model: Any, document: Document, error: ValidationError) -> list[str]:
    """One line for each wrong key, in the order in which a user corrects them."""
    # A misspelt key is often the reason for a missing one, so it is reported first.
    problems = sorted(
        error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden"
    )
    lines: dict[Key, str] = {}
    for problem in problems:
        key = _as_written(document.data, tuple(problem["loc"]))
        told = what_is_wrong(model, key, problem)
        # A value with several possible types fails as each of them.
        lines.setdefault(key, f"{document.place(key or _named_in(told, document))}: {told}")
    # A list with a wrong item is too short as well, and a section is no word.
    return [line for key, line in lines.items() if not any(key == each[: len(key)] != each for each in lines)]


def _named_in(told: str, document: Document) -> Key:
    """The first key with dots, in the message of a check of several keys, that the user wrote; empty if there is none."""
    keys = (tuple(name.split(".")) for name in _DOTTED.findall(told))
    return next((key for key in keys if key in document.places), ())


def what_is_wrong(model: Any, key: Key, problem: Any) -> str:
    """One of pydantic's errors in our words; ``key`` is where the user wrote it."""
    name = ".".join(map(str, key)) or "the whole"
    if problem["type"] == "extra_forbidden":
        valid = ", ".join(_valid_keys(model, tuple(problem["loc"])[:-1])) or "none"
        return f"unknown key {name}; valid keys here: {valid}"
    if problem["type"] == "too_short":
        return f"{name}: expected at least {problem['ctx']['min_length']}, got {problem['ctx']['actual_length'] or 'none'}"
    if problem["type"] == "missing":
        return f"{name} is missing; add it"
    if problem["type"] == "union_tag_not_found":
        tag = str(problem["ctx"]["discriminator"]).strip("'")
        return f"{name}.{tag} is missing; add it" if key else f"{tag} is missing; add it"
    if problem["type"] in _NOT_OF_YAML:
        is_item = problem["type"] in ("tuple_type", "list_type") and isinstance(problem["input"], int | float)
        advice = f"; write [{problem['input']}]" if is_item else ""
        return f"{name}: expected {_NOT_OF_YAML[problem['type']]}, got {problem['input']!r:.80}{advice}"
    if problem["type"] == "union_tag_invalid":
        context = problem["ctx"]
        return f"{name}: expected {context['discriminator']} to be one of {context['expected_tags']}, got {context['tag']!r}"
    message = str(problem["msg"]).removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    # The error of a check of several keys, or of a name, includes the input; the whole file would not help.
    if not key:
        return message
    if problem["type"] == COMPLETE:
        return f"{name}: {message}"
    advice = "; write true or false" if problem["type"] in ("bool_type", "bool_parsing") else ""
    return f"{name}: {message}, got {problem['input']!r:.80}{advice}"


def _as_written(data: Any, location: Key) -> Key:
    """Path of a key in the user's file, without the ``kind``, the tag or the type that pydantic inserts for values of several types."""
    key: list[str | int] = []
    for part in location:
        inserted = _INSERTED.search(str(part)) or (isinstance(data, dict) and data.get("kind") == part)
        if inserted and not (isinstance(data, dict) and part in data):
            continue
        key.append(part)
        inside = isinstance(data, dict) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        )
        data = (data.get(part) if isinstance(data, dict) else data[part]) if inside else None
    return tuple(key)


def _valid_keys(annotation: Any, key: Key) -> list[str]:
    """Keys of the model at a path; empty without a model."""
    if typing.get_origin(annotation) is typing.Annotated:
        annotation = typing.get_args(annotation)[0]
    if hints := _hints(annotation):
        if not key:
            return sorted(hints)
        return _valid_keys(hints[str(key[0])], key[1:]) if key[0] in hints else []
    arguments = typing.get_args(annotation)
    origin = typing.get_origin(annotation)
    if origin in (Union, types.UnionType):
        named = (
            option for option in arguments if key and key[0] in (_kind(option), _tag(option), _name(option))
        )
        if chosen := list(named):
            return _valid_keys(chosen[0], key[1:])
        return next((keys for option in arguments if (keys := _valid_keys(option, key))), [])
    if key and arguments and isinstance(origin, type) and issubclass(origin, typing.Iterable):
        return _valid_keys(arguments[-1] if issubclass(origin, dict) else arguments[0], key[1:])
    return []


def _tag(option: Any) -> Any:
    """The tag of a model that a function selects; None without one."""
    return next((each.tag for each in typing.get_args(option) if isinstance(each, Tag)), None)


def _name(option: Any) -> Any:
    """The name of a class, which selects it where nothing else does."""
    return getattr(option, "__name__", None)


def _kind(option: Any) -> Any:
    """The ``kind`` value that selects a model; None if the model has no ``kind``."""
    fields = option.model_fields if isinstance(option, type) and issubclass(option, BaseModel) else {}
    return fields["kind"].default if "kind" in fields else None
