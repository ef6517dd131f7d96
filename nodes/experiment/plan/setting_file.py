"""Reads an experiment file with one of its settings. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.documents import Document, Key, read_yaml
from nodes.runtime.config import apply_overrides
from nodes.runtime.errors import ConfigError


def read_setting(file: Path, setting: str, overrides: Sequence[str]) -> Document:
    """An experiment file with one of its settings laid over its values, and overrides over that; see `load_experiment`."""
    document = _on_its_base(file, ())
    settings = document.data.pop("settings", None) or {}
    if setting not in settings:
        raise ConfigError(f"{file}: no setting called {setting!r}; known are {', '.join(settings) or 'none'}")
    _lay_over(document, settings[setting] or {}, ("settings", setting), ())
    apply_overrides(document, overrides)
    return document


def _on_its_base(file: Path, above: Sequence[Path]) -> Document:
    """An experiment file, laid over the file that its key ``base`` names, if it has one."""
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{file}: expected an experiment file with keys and values")
    base = document.data.pop("base", None)
    if base is None:
        return document
    at = file.parent / str(base)
    if at.resolve() in [each.resolve() for each in (*above, file)]:
        raise ConfigError(
            f"{document.place(('base',))}: expected a base other than the file itself, got {base}"
        )
    under = _on_its_base(at, (*above, file))
    _lay_over(under, document.data, (), (), document.places)
    return Document(under.data, document.source, under.places)


def _lay_over(
    document: Document,
    values: dict[str, Any],
    origin: tuple[str, ...],
    key: tuple[str, ...],
    places: Mapping[Key, str] | None = None,
) -> None:
    """Merge values into the document, keeping for each the place where it stands: in ``places``, or in the document itself under ``origin``."""
    source = document.places if places is None else places
    target = document.data
    for step in key:
        if not isinstance(target.get(step), dict):
            target[step] = {}
        target = target[step]
    for name, value in values.items():
        here, there = (*key, name), (*origin, *key, name)
        before = target.get(name)
        if isinstance(value, dict) and isinstance(before, dict) and not _another_kind(before, value):
            _lay_over(document, value, origin, here, places)
            continue
        target[name] = value
        document.places[here] = next(
            (source[there[:end]] for end in range(len(there), 0, -1) if there[:end] in source),
            document.source,
        )
        document.places |= {
            (*here, *at[len(there) :]): place for at, place in source.items() if at[: len(there)] == there
        }


def _another_kind(before: Mapping[str, Any], value: Mapping[str, Any]) -> bool:
    """Whether a section is of another ``kind``, whose keys are others: it takes the place of the one before."""
    return "kind" in value and value["kind"] != before.get("kind")
