"""Whether a finished run folder was made with the settings of an experiment, so that its results may be taken."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from hardware.twin.config import LabConfig
from nodes.experiment import attack
from nodes.experiment.config import ExperimentConfig
from nodes.experiment.context import Experiment
from nodes.runtime.errors import ConfigError
from nodes.runtime.stages import read_record

# What does not change a result: which other seeds there are, and how much memory may be used.
_FREE = ("seeds", "cache_mib")


def has_same_attacks(experiment: Experiment) -> bool:
    """Whether the run folder's attacks are finished, and are those of these settings on the scene and policies that are there now."""
    folder = experiment.stage_folder("attack")
    if not is_finished(folder):
        return False
    then, now = json.loads((folder / "frozen.json").read_text()), attack.frozen_hashes(experiment)
    # Starts depend on the seed alone; which seeds the folder had, and hence this hash, does not matter here.
    if any(then.get(name) != now[name] for name in now if name not in ("config", "starts_and_seeds")):
        return False
    old, new = _manifest_config(experiment), experiment.config
    return old.horizon == new.horizon and all(
        getattr(new.attack, name) == value for name, value in old.attack.model_dump().items() if name not in _FREE
    )


def _manifest_config(experiment: Experiment) -> ExperimentConfig:
    try:
        manifest = json.loads((experiment.folder / "manifest.json").read_text())
        return ExperimentConfig.model_validate(manifest["config"])
    except (OSError, ValueError, KeyError, ValidationError) as error:
        first = str(error).splitlines()[0]
        raise ConfigError(
            f"expected {experiment.folder}/manifest.json to say with which settings the folder was made, got: {first}; name another run_folder"
        ) from None


def changed_settings(experiment: Experiment) -> list[str]:
    """What the run folder was made with that the experiment says otherwise; values that are new have their defaults."""
    old, new = _manifest_config(experiment), experiment.config
    changed = [
        f"{section}.{name}"
        for section in ("capture", "scene", "policy", "object")
        for name, value in getattr(old, section).model_dump().items()
        if getattr(getattr(new, section), name) != value
    ]
    lab = LabConfig.model_validate(old.lab).model_dump()
    return changed + [f"lab.{name}" for name, value in experiment.lab_config.model_dump().items() if lab[name] != value]


def is_finished(folder: Path) -> bool:
    """Whether a stage's folder holds a finished result."""
    record = read_record(folder)
    return record is not None and record.digest is not None
