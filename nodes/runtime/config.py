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
