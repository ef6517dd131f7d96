"""Load the configuration of nodes: a file, overrides of it, and the copy that the launch supervisor writes."""

from __future__ import annotations

import typing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from advnerf_core.documents import Document, Key, parse_yaml, read_yaml
from advnerf_core.strict import validate
from nodes.runtime.errors import ConfigError

M = TypeVar("M")
_NONE = ("", "null", "Null", "NULL", "~")


def key_and_value(
    option: str,
    text: str,
    example: str,
    form: str = "KEY=VALUE",
    separator: str = "=",
    needs_value: bool = False,
) -> tuple[str, str]:
    """Both sides of the text of an option, the value as it was written.

    Args:
        form: What is expected, for the error.
        needs_value: Whether an empty value is refused, too; an empty key always is.

    Raises:
        ConfigError: The text has another form.
    """
    key, found, value = text.partition(separator)
    if not found or not key.strip() or (needs_value and not value.strip()):
        raise ConfigError(f"{option} {text}: expected {form}, for example {option} {example}")
    return key.strip(), value


def typed_values(option: str, texts: Iterable[str], example: str) -> dict[str, Any]:
    """The values of ``KEY=VALUE`` texts of an option, which are YAML."""
    pairs = [(text, *key_and_value(option, text, example)) for text in texts]
    return {key: _value_of(value, f"{option} {text}") for text, key, value in pairs}


def _value_of(text: str, source: str) -> Any:
    """The YAML value of a text; None if it is empty or null, where an empty file has no keys."""
    return parse_yaml(text, source).data if text.strip() not in _NONE else None


def apply_overrides(document: Document, overrides: Iterable[str], prefix: Key = ()) -> None:
    """Apply ``key.of.it=value`` overrides in place. Values are YAML, and keys are relative to ``prefix``."""
    for text in overrides:
        name, value = key_and_value("--set", text, "camera.rate_hz=10")
        key: Key = (*prefix, *name.split("."))
        parsed = _value_of(value, f"--set {text}")
        target = document.data
        for number, step in enumerate(key, start=1):
            if not isinstance(target, dict):
                raise ConfigError(
                    f"--set {text}: expected a section above {step!r}, got a value without keys; correct the key"
                )
            if number == len(key):
                target[step] = parsed
            elif target.get(step) is None:
                target[step] = {}
            target = target[step]
        document.places[key] = f"--set {text}"


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
    return validate(model, document, None if path is None else Path(path).parent)


def node_document(document: Document) -> dict[str, Any]:
    """Content of the file that the supervisor writes for a node, the counterpart of `load_node_config`."""
    return {
        "config": document.data,
        "places": {".".join(map(str, key)): place for key, place in document.places.items()},
    }
