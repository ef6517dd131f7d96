"""Reads an experiment file with one of its settings, and its variants. Needs no torch."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from advnerf_core.documents import Document, Key, read_yaml
from nodes.experiment.plan.over import (
    COORDINATES,
    OVER,
    AxisChange,
    coordinates_in,
    variants_in,
    with_dotted_axes,
)
from nodes.runtime.config import apply_overrides
from nodes.runtime.errors import ConfigError

# Default for a file with settings.
DEFAULT_SETTING = "demo"
# Keys of the whole experiment, not of a variant.
_OF_THE_WHOLE = ("name", "run_folder", "contrasts", "claims")


@dataclass(frozen=True)
class ExperimentFile:
    """An experiment file with one of its settings laid over its values, and overrides over that.

    Attributes:
        setting: Name of the setting; empty for a file without settings.
        document: The values.
        of: Name of the experiment that it changes: its base's, or its own.
        variants: The values of each variant of the section ``over``, once they are read.
    """

    setting: str
    document: Document
    of: Any
    variants: Mapping[str, Document] = field(default_factory=dict)


def read_experiment_file(file: Path, setting: str | None, overrides: Sequence[str]) -> ExperimentFile:
    """Read an experiment file and its variants; see `load_experiment`."""
    read = _with_setting(file, setting, ())
    apply_overrides(read.document, overrides)
    with_dotted_axes(read.document)
    over = read.document.data.get(OVER)
    try:
        changes = variants_in(over)
    except ValueError as error:
        raise ConfigError(f"{read.document.place((OVER,))}: {error}") from None
    variants = {name: _variant(file, read, each, overrides) for name, each in changes.items()}
    return replace(read, variants=variants)


def _with_setting(file: Path, setting: str | None, above: Sequence[Path]) -> ExperimentFile:
    """An experiment file on its base, if it has one. The base's entry of the setting is laid over the base, and the file over both."""
    layers = _layers(file, above)
    known = dict.fromkeys(name for layer in layers for name in layer.data.get("settings") or {})
    if setting is None:
        setting = DEFAULT_SETTING if known else ""
        if known and setting not in known:
            raise ConfigError(
                f"{file}: expected one of the settings {', '.join(known)}, got none; give --setting, or call one {DEFAULT_SETTING}"
            )
    elif setting not in known and (setting or known):
        raise ConfigError(f"{file}: no setting called {setting!r}; known are {', '.join(known) or 'none'}")
    names = [layer.data.get("name") for layer in layers]
    for layer in layers:
        chosen = (layer.data.pop("settings", None) or {}).get(setting)
        _lay_over(layer, chosen or {}, ("settings", setting), ())
    document = layers[0]
    for layer in layers[1:]:
        _lay_over(document, layer.data, (), (), layer.places)
    of = next((name for name in reversed(names[:-1]) if name), document.data.get("name"))
    return ExperimentFile(setting, document, of)


def _layers(file: Path, above: Sequence[Path]) -> list[Document]:
    """An experiment file with what it builds on, the lowest first: a base with a setting of its own is one layer, with that setting."""
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{file}: expected an experiment file with keys and values")
    base, setting = document.data.pop("base", None), document.data.pop("setting", None)
    if base is None:
        if setting is not None:
            raise ConfigError(
                f"{document.place(('setting',))}: expected setting only with base, whose setting it names, got {setting}; name the settings of "
                "this file under settings"
            )
        return [document]
    at = file.parent / str(base)
    if at.resolve() in [each.resolve() for each in (*above, file)]:
        raise ConfigError(
            f"{document.place(('base',))}: expected a base other than the file itself, got {base}"
        )
    below = (
        _layers(at, (*above, file))
        if setting is None
        else [_with_setting(at, str(setting), (*above, file)).document]
    )
    for layer in below:
        layer.data = _seen_from(file.parent, at.parent, layer.data)
    return [*below, document]


def _seen_from(folder: Path, other: Path, value: Any) -> Any:
    """A value of a file in ``other`` for a file in ``folder``: names of files there, also of ``FILE.py:NAME``, become paths to them from here."""
    if folder.resolve() == other.resolve():
        return value
    if isinstance(value, dict):
        return {key: _seen_from(folder, other, each) for key, each in value.items()}
    if isinstance(value, list):
        return [_seen_from(folder, other, each) for each in value]
    if not isinstance(value, str) or not Path(value.partition(":")[0]).suffix:
        return value
    name, colon, rest = value.partition(":")
    there = other / name
    return os.path.relpath(there, folder) + colon + rest if there.is_file() else value


def _variant(
    file: Path, read: ExperimentFile, changes: Sequence[AxisChange], overrides: Sequence[str]
) -> Document:
    """The values of one variant: the experiment's, or its own base's, with its changes and the overrides."""
    values = {change.key: change.value for change in changes}
    base, setting = values.pop("base", None), values.pop("setting", None)
    if base is None:
        made = Document(copy.deepcopy(read.document.data), read.document.source, dict(read.document.places))
        made.data["name"] = read.of
    else:
        at = file.parent / str(base)
        made = _with_setting(at, setting, (file,)).document
        made.data = _seen_from(file.parent, at.parent, made.data)
    whole = read.document.data.get(OVER)
    made.data[OVER] = copy.deepcopy(coordinates_in(made.data.get(OVER)) | coordinates_in(whole))
    for key in _OF_THE_WHOLE[1:]:
        made.data.pop(key, None)
    for change in changes:
        if change.key in values:
            _change(made, change, read.document)
    apply_overrides(made, [text for text in overrides if _is_of_variants(text)])
    return made


def _change(made: Document, change: AxisChange, document: Document) -> None:
    """Apply one change of a variant to its values."""
    steps, value = tuple(change.key.split(".")), copy.deepcopy(change.value)
    places = {
        (*steps, *at[len(change.origin) :]): place
        for at, place in document.places.items()
        if at[: len(change.origin)] == change.origin
    }
    for step in reversed(steps):
        value = {step: value}
    _lay_over(made, value, (), (), {steps: document.place(change.origin)} | places)


def _is_of_variants(override: str) -> bool:
    """Whether an override changes every variant, rather than the list of variants."""
    first, _, rest = override.partition("=")[0].strip().partition(".")
    return rest.partition(".")[0] in COORDINATES if first == OVER else first not in _OF_THE_WHOLE


def _lay_over(
    document: Document,
    values: dict[str, Any],
    origin: tuple[str, ...],
    key: tuple[str, ...],
    places: Mapping[Key, str] | None = None,
) -> None:
    """Merge values into the document, keeping the place of each: from ``places``, or from the document itself under ``origin``."""
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
    """Whether a section has another ``kind``, with other keys: it then replaces the earlier one."""
    return "kind" in value and value["kind"] != before.get("kind")
