"""Whether a finished run folder was made with the settings of an experiment, so that its results may be taken.

Every stage's record says with which settings it was made; the manifest says only what was asked for last.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from nodes.experiment import attack
from nodes.experiment.context import Experiment
from nodes.experiment.run import stages_of
from nodes.experiment.stages import fits_what_is_there, is_current, read_record

# What does not change a result: which other seeds there are, and how much memory may be used.
_FREE = ("seeds", "cache_mib")
_MADE = ("capture", "scene", "policy", "object")


def has_same_attacks(experiment: Experiment) -> bool:
    """Whether the run folder's attacks are finished, and are those of these settings on the scene and policies that are there now."""
    folder = experiment.stage_folder("attack")
    settings = _settings_of(folder)
    if not is_finished(folder) or settings is None:
        return False
    then, now = json.loads((folder / "frozen.json").read_text()), attack.frozen_hashes(experiment)
    # Starts depend on the seed alone; which seeds the folder had, and hence this hash, does not matter here.
    if any(then.get(name) != now[name] for name in now if name not in ("config", "starts_and_seeds")):
        return False
    now_attack = experiment.config.attack
    changed = _changed(now_attack, settings.get(type(now_attack).__name__), "attack")
    return settings["horizon"] == experiment.config.horizon and set(changed) <= {
        f"attack.{name}" for name in _FREE
    }


def has_same_graph(experiment: Experiment) -> bool:
    """Whether the run folder's live drives went through the node graph of this experiment."""
    settings = _settings_of(experiment.stage_folder("deploy"))
    if settings is None:
        return False
    now = next(stage.settings for stage in stages_of(experiment) if stage.name == "deploy")
    old, new = (each[type(experiment.config.deploy).__name__] for each in (settings, now))
    same = all(old.get(name) == new[name] for name in ("launch_file", "nodes"))
    return same and settings["graph"] == json.loads(json.dumps(now["graph"]))


def changed_settings(experiment: Experiment) -> list[str]:
    """What the run folder was made with that the experiment says otherwise; values that are new have their defaults."""
    stages, found = stages_of(experiment), []
    for stage in stages:
        if stage.name not in _MADE:
            continue
        settings = _settings_of(experiment.stage_folder(stage.name))
        if (
            settings is None
        ):  # of before settings were kept: the key says whether they are the same, not which differ
            found += [] if is_current(stages, experiment.folder, stage.name) else [stage.name]
            continue
        if not fits_what_is_there(stage, experiment.folder):
            found.append(f"{stage.name} (it was made before what it builds on)")
        found += _changed(experiment.lab_config, settings["lab"], "lab")
        for section in _MADE:
            values = getattr(experiment.config, section)
            if type(values).__name__ in settings:
                found += _changed(values, settings[type(values).__name__], section)
    return list(dict.fromkeys(found))


def is_finished(folder: Path) -> bool:
    """Whether a stage's folder holds a finished result."""
    record = read_record(folder)
    return record is not None and record.digest is not None


def _settings_of(folder: Path) -> Mapping[str, Any] | None:
    record = read_record(folder)
    return None if record is None else record.settings


def _changed(now: BaseModel, settings: Any, section: str) -> list[str]:
    """Names of values of a section that a stage was made with otherwise."""
    try:
        then = type(now).model_validate(settings)
    except ValidationError:
        return [section]
    return [f"{section}.{name}" for name, value in then if getattr(now, name) != value]
