"""What one kind of cell is told beyond its experiment: ``set: [poses.move_m=1.0]`` of a campaign's scenario."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import TypeAdapter, ValidationError

from nodes.experiment.campaign.kinds import stage_digests
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.policy import victim_file
from nodes.experiment.junction.run import load_experiment
from nodes.runtime.config import Document, apply_overrides
from nodes.runtime.errors import ConfigError

S = TypeVar("S")
E = TypeVar("E")


def split_settings(kind: type[S], section: str, overrides: Sequence[str]) -> tuple[S, list[str]]:
    """The settings of a kind of cell, and the texts that are left for its experiment.

    Args:
        kind: A dataclass; its defaults stand where nothing is said.
        section: What comes before the dot in the texts that are meant.
        overrides: ``key.of.it=value`` texts.

    Raises:
        ConfigError: No such setting, or not such a value.
    """
    own = [text for text in overrides if text.partition("=")[0].partition(".")[0] == section]
    document = Document({}, "the changes of the scenario")
    apply_overrides(document, own)
    data = document.data.get(section, {})
    _refuse_unknown(kind, data, document, (section,))
    try:
        settings = TypeAdapter(kind).validate_python(_over(asdict(kind()), data))  # type: ignore[call-overload]
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = (section, *first["loc"])
        raise ConfigError(
            f"{document.place(key)}: {'.'.join(map(str, key))}: {_lower(first['msg'])}, got {first['input']!r:.80}"
        ) from None
    return settings, [text for text in overrides if text not in own]


def load_with(
    settled: Callable[..., E], kind: type[Any], section: str, file: Path, setting: str, overrides: Sequence[str], folder: Path
) -> E:  # fmt: skip
    """The experiment together with the settings of its cells, as ``settled(config, file, folder, setting, settings)``."""
    settings, others = split_settings(kind, section, overrides)
    base = load_experiment(file, setting, others, folder)
    if base.config.kind == "carla":
        raise ConfigError(
            f"{file}: expected an experiment of kind intersection for cells of places or meshes, got carla: they run beside one another, and a CARLA "
            "server steps one world at a time; use kind: carla in the campaign for colours"
        )
    return settled(base.config, base.file, base.folder, base.setting, settings)


def inputs_of(experiment: Experiment, victim: str, digest: Callable[[], str]) -> dict[str, Any]:
    """What a cell depends on; not known before there is a victim."""
    if not victim_file(experiment, victim).exists():
        return {"stages": stage_digests(experiment.folder), "victim": None}
    return {"everything": digest()}


def _over(defaults: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    """Values over defaults, section by section: a default of the whole may differ from that of its section."""
    inner = {key: _over(defaults[key], value) for key, value in data.items() if isinstance(defaults.get(key), dict)}
    return {**defaults, **data, **inner}


def _refuse_unknown(kind: Any, data: Any, document: Document, key: tuple[str, ...]) -> None:
    """Dataclasses take what they do not know in silence."""
    name = ".".join(key)
    if not isinstance(data, dict):
        raise ConfigError(f"{document.place(key)}: expected keys below {name}, got {data!r:.80}")
    hints = get_type_hints(kind)
    for known, value in data.items():
        if known not in hints:
            names = ", ".join(f"{name}.{each.name}" for each in fields(kind))
            raise ConfigError(f"{document.place((*key, known))}: unknown key {name}.{known}; valid keys here: {names}")
        if is_dataclass(hints[known]):
            _refuse_unknown(hints[known], value, document, (*key, known))


def _lower(text: Any) -> str:
    said = str(text).removeprefix("Value error, ")
    return said[:1].lower() + said[1:]
