"""Runs an experiment file: resolves it, runs its stages, prints the table. Called by ``advnerf experiment``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from rich.console import Console

from hardware.worlds.lab.config import LabConfig
from nodes.experiment import attack, capture, deploy, objects, policy, report, scene
from nodes.experiment.config import ExperimentConfig
from nodes.experiment.context import Experiment
from nodes.experiment.run_folder import run_to_end
from nodes.experiment.stages import Stage, StageRecord
from nodes.launching.launch_file import load_launch
from nodes.runtime.config import Document, apply_overrides, read_yaml, validate
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report

_LIBRARIES = (
    "torch",
    "numpy",
    "numba",
    "opencv-contrib-python-headless",
    "mujoco",
    "pyzmq",
    "rosbags",
    "mcap",
)
STAGES = ("capture", "scene", "policy", "object", "attack", "deploy", "report")


def load_experiment(file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Experiment:
    """Resolve an experiment file.

    Args:
        file: A ``*.experiment.yaml`` file.
        setting: Which of its settings to lay over its values.
        overrides: ``section.key=value`` texts, applied last.
        folder: The run folder.

    Raises:
        ConfigError: With file, line and the valid keys.
    """
    document = read_setting(file, setting, overrides)
    config = validate(ExperimentConfig, document)
    validate(LabConfig, document.part(("lab",)))
    return Experiment(config, file.resolve(), folder.resolve(), setting)


def is_in_a_world(file: Path) -> bool:
    """Whether an experiment file names a world; one that does not is the room's."""
    data = read_yaml(file).data
    return isinstance(data, dict) and "world" in data


def read_setting(file: Path, setting: str, overrides: Sequence[str]) -> Document:
    """An experiment file with one of its settings laid over its values, and overrides over that; see `load_experiment`."""
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{file}: expected an experiment file with keys and values")
    settings = document.data.pop("settings", None) or {}
    if setting not in settings:
        raise ConfigError(f"{file}: no setting called {setting!r}; known are {', '.join(settings) or 'none'}")
    _lay_over(document, settings[setting] or {}, ("settings", setting), ())
    apply_overrides(document, overrides)
    return document


def run_experiment(
    experiment: Experiment, until: str | None = None, console: Console | None = None
) -> dict[str, StageRecord]:
    """Run the stages that are not there yet, and print the result of a finished experiment."""
    summarise = partial(report.print_summary, experiment)
    return run_to_end(experiment, stages_of(experiment), _LIBRARIES, summarise, until, console)


def stages_of(experiment: Experiment) -> list[Stage]:
    """The stages with the part of the configuration that each depends on."""
    config = experiment.config
    lab = experiment.lab_config.model_dump(mode="json")

    def stage(name: str, module: Any, sections: Sequence[BaseModel], after: Sequence[str]) -> Stage:
        settings = {
            "lab": lab,
            "horizon": config.horizon if name in ("attack", "deploy", "report") else None,
            **{type(s).__name__: s.model_dump(mode="json") for s in sections},
        }
        if name == "deploy":
            settings["graph"] = load_launch(experiment.launch_file).resolved

        def work(folder: Path, told: Report) -> None:
            module.run(experiment, folder, told)

        return Stage(name, work, settings, after)

    return [
        stage("capture", capture, [config.capture], ()),
        stage("scene", scene, [config.scene], ("capture",)),
        stage("policy", policy, [config.policy, config.object], ("capture", "scene")),
        stage("object", objects, [config.object], ("capture", "scene")),
        stage(
            "attack",
            attack,
            [config.policy, config.object, config.attack],
            ("capture", "scene", "policy", "object"),
        ),
        stage(
            "deploy", deploy, [config.policy, config.deploy, config.attack], ("capture", "policy", "attack")
        ),
        stage("report", report, [config], ("capture", "scene", "policy", "object", "attack", "deploy")),
    ]


def _lay_over(
    document: Document, values: dict[str, Any], origin: tuple[str, ...], key: tuple[str, ...]
) -> None:
    """Merge a setting into the document, keeping for each value the place where it stands in the file."""
    target = document.data
    for step in key:
        target = target.setdefault(step, {})
    for name, value in values.items():
        if isinstance(value, dict):
            _lay_over(document, value, origin, (*key, name))
        else:
            target[name] = value
            document.places[(*key, name)] = document.place((*origin, *key, name))
