"""Load YAML configuration into typed objects. An error names the file, the line and the valid values."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, Union

import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError

from nodes.runtime.errors import ConfigError

# Type of a pydantic error whose message says what came.
COMPLETE = "complete"

M = TypeVar("M")
Key = tuple[str | int, ...]


@dataclass
class Document:
    """A parsed YAML file that knows the line of every key.

    Attributes:
        data: Content of the file.
        source: File name for error messages.
        places: Origin of each key by its path: ``file:line``, or the override that set it.
    """

    data: Any
    source: str
    places: dict[Key, str] = field(default_factory=dict)

    def place(self, key: Key) -> str:
        """Origin of a key, or of the nearest enclosing key."""
        while key and key not in self.places:
            key = key[:-1]
        return self.places.get(key, self.source)

    def part(self, key: Key) -> Document:
        """Return the section under a key with its places; empty if the key is missing."""
        data = self.data
        for step in key:
            data = (data or {}).get(step) if isinstance(data, dict) else data[step]
        places = {path[len(key) :]: place for path, place in self.places.items() if path[: len(key)] == key}
        places.setdefault((), self.place(key))
        return Document({} if data is None else data, self.source, places)


def read_yaml(path: Path) -> Document:
    """Parse a YAML or JSON file. Tags that build objects are refused, and a duplicate key is an error."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: expected a file, found none; correct the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: expected a readable file: {error}") from error
    return parse_yaml(text, str(path))


def parse_yaml(text: str, source: str) -> Document:
    """Parse YAML text. Error messages refer to the text as ``source``."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        raise ConfigError(
            f"{source}{line}: expected valid YAML: {getattr(error, 'problem', None) or error}"
        ) from error
    document = Document({} if data is None else data, source)
    if root is not None:
        _note_places(root, (), document)
    return document


def _note_places(node: yaml.Node, key: Key, document: Document) -> None:
    document.places.setdefault(key, f"{document.source}:{node.start_mark.line + 1}")
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for name, value in node.value:
            here = f"{document.source}:{name.start_mark.line + 1}"
            if name.value in seen:
                raise ConfigError(
                    f"{here}: {'.'.join(map(str, (*key, name.value)))} is given twice; remove one of them"
                )
            seen.add(name.value)
            document.places[(*key, name.value)] = here
            _note_places(value, (*key, name.value), document)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _note_places(value, (*key, index), document)


_NONE = ("", "null", "Null", "NULL", "~")


def apply_overrides(document: Document, overrides: Iterable[str], prefix: Key = ()) -> None:
    """Apply ``key.of.it=value`` overrides in place. Values are YAML, and keys are relative to ``prefix``."""
    for text in overrides:
        name, separator, value = text.partition("=")
        if not separator or not name.strip():
            raise ConfigError(f"--set {text}: expected KEY=VALUE, for example --set camera.rate_hz=10")
        key: Key = (*prefix, *name.strip().split("."))
        # An empty file has no keys. An empty value, or null, is None.
        parsed = parse_yaml(value, f"--set {text}").data if value.strip() not in _NONE else None
        target = document.data
        for step in key[:-1]:
            if not isinstance(target, dict):
                raise ConfigError(
                    f"--set {text}: expected a section above {step!r}, got a value without keys; correct the key"
                )
            if target.get(step) is None:
                target[step] = {}
            target = target[step]
        if not isinstance(target, dict):
            raise ConfigError(
                f"--set {text}: expected a section above {key[-1]!r}, got a value without keys; correct the key"
            )
        target[key[-1]] = parsed
        document.places[key] = f"--set {text}"


def validate(model: type[M], document: Document, folder: Path | None = None) -> M:
    """Typed object of a document; anything unknown or invalid is one `ConfigError`.

    Args:
        model: A pydantic model or a dataclass.
        document: What it is made of.
        folder: What ``file.py:Name`` in it is relative to; the working folder if it is not given.
    """
    if not isinstance(document.data, dict):
        raise ConfigError(
            f"{document.place(())}: expected keys and values, got {type(document.data).__name__}"
        )
    _refuse_unknown(model, document, ())
    try:
        return TypeAdapter(model).validate_python(document.data, context={"folder": folder})
    except ValidationError as error:
        raise ConfigError(_explain(model, document, error)) from None


def load_config(model: type[M], path: Path, overrides: Sequence[str] = ()) -> M:
    """Read, override and validate a configuration file."""
    document = read_yaml(path)
    apply_overrides(document, overrides)
    return validate(model, document, Path(path).parent)


def load_node_config(model: type[M], node: str, path: Path | None, overrides: Sequence[str] = ()) -> M:
    """Load the configuration of one node.

    The file is either plain (keys and values) or written by the launch supervisor: keys and values under ``config``, and their
    origin in the user's launch file under ``places``, so that an error names the launch file instead of the copy.
    """
    document = Document({}, f"defaults of {node}") if path is None else read_yaml(path)
    if isinstance(document.data, dict) and set(document.data) == {"config", "places"}:
        places = {
            tuple(name.split(".")) if name else (): place for name, place in document.data["places"].items()
        }
        document = Document(document.data["config"], document.source, typing.cast("dict[Key, str]", places))
    apply_overrides(document, overrides)
    return validate(model, document)


def node_document(document: Document) -> dict[str, Any]:
    """Content of the file that the supervisor writes for a node, the counterpart of `load_node_config`."""
    return {
        "config": document.data,
        "places": {".".join(map(str, key)): place for key, place in document.places.items()},
    }


def _refuse_unknown(model: Any, document: Document, key: Key) -> None:
    """Refuse unknown keys of models that would take them in silence: dataclasses, and pydantic models that say nothing about extra keys."""
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
        if name not in hints:
            written = ".".join(map(str, (*key, name)))
            raise ConfigError(
                f"{document.place((*key, name))}: unknown key {written}; valid keys here: {', '.join(sorted(hints)) or 'none'}"
            )
        _refuse_unknown(hints[name], document, (*key, name))


def _hints(model: Any) -> dict[str, Any]:
    """Fields of a model by the name that stands in files; empty if it is none."""
    if isinstance(model, type) and issubclass(model, BaseModel):
        return {each.alias or name: each.annotation for name, each in model.model_fields.items()}
    if isinstance(model, type) and dataclasses.is_dataclass(model):
        known = typing.get_type_hints(model)
        return {each.name: known[each.name] for each in dataclasses.fields(model) if each.init}
    return {}


def _explain(model: Any, document: Document, error: ValidationError) -> str:
    # A misspelt key is often the reason for a missing one, so it is reported first.
    problems = sorted(
        error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden"
    )
    first = problems[0]
    location = tuple(first["loc"])
    key = _as_written(document.data, location)
    name = ".".join(map(str, key)) or "the whole"
    if first["type"] == "extra_forbidden":
        what = (
            f"unknown key {name}; valid keys here: {', '.join(_valid_keys(model, location[:-1])) or 'none'}"
        )
    elif first["type"] == "missing":
        what = f"{name} is missing; add it"
    else:
        message = str(first["msg"]).removeprefix("Value error, ")
        message = message[:1].lower() + message[1:]
        # A check of several keys together, or of a name, says itself what it got; all of a file would not help.
        complete = not key or first["type"] == COMPLETE
        what = (
            (f"{name}: {message}" if key else message)
            if complete
            else f"{name}: {message}, got {first['input']!r:.80}"
        )
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{document.place(key)}: {what}{more}"


def _as_written(data: Any, location: Key) -> Key:
    """Path of a key as the user wrote it, without the ``kind`` that pydantic inserts for sections with several models."""
    key: list[str | int] = []
    for part in location:
        if isinstance(data, dict) and part not in data and data.get("kind") == part:
            continue
        key.append(part)
        inside = isinstance(data, dict) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        )
        data = (data.get(part) if isinstance(data, dict) else data[part]) if inside else None
    return tuple(key)


def _valid_keys(annotation: Any, key: Key) -> list[str]:
    """Keys of the model at a path; empty if there is no model."""
    if typing.get_origin(annotation) is typing.Annotated:
        annotation = typing.get_args(annotation)[0]
    if hints := _hints(annotation):
        if not key:
            return sorted(hints)
        return _valid_keys(hints[str(key[0])], key[1:]) if key[0] in hints else []
    arguments = typing.get_args(annotation)
    origin = typing.get_origin(annotation)
    if origin in (Union, types.UnionType):
        if key and (chosen := [option for option in arguments if _kind(option) == key[0]]):
            return _valid_keys(chosen[0], key[1:])
        return next((keys for option in arguments if (keys := _valid_keys(option, key))), [])
    if key and arguments and isinstance(origin, type) and issubclass(origin, typing.Iterable):
        return _valid_keys(arguments[-1] if issubclass(origin, dict) else arguments[0], key[1:])
    return []


def _kind(option: Any) -> Any:
    """The ``kind`` value that selects a model; None if the model has no ``kind``."""
    fields = option.model_fields if isinstance(option, type) and issubclass(option, BaseModel) else {}
    return fields["kind"].default if "kind" in fields else None
