"""Runs an experiment of kind ``intersection``: resolves its file, runs its stages, prints the table."""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console

from advnerf_core.files import write_atomically
from hardware.twin.intersection.config import IntersectionConfig
from nodes.experiment.run import read_setting
from nodes.intersection import attack, capture, deploy, objects, policy, report, retrain, scene
from nodes.intersection.config import IntersectionExperimentConfig
from nodes.intersection.context import Experiment
from nodes.runtime.config import validate
from nodes.runtime.progress import ProgressDisplay
from nodes.runtime.stages import Report, Stage, StageRecord, check_until, run_stages

_LIBRARIES = ("torch", "numpy", "numba", "opencv-contrib-python-headless", "mujoco")


def load_experiment(file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Experiment:
    """Resolve an experiment file.

    Args:
        file: A ``*.experiment.yaml`` file with ``kind: intersection``.
        setting: Which of its settings to lay over its values.
        overrides: ``section.key=value`` texts, applied last.
        folder: The run folder.

    Raises:
        ConfigError: With file, line and the valid keys.
    """
    document = read_setting(file, setting, overrides)
    config = validate(IntersectionExperimentConfig, document)
    validate(IntersectionConfig, document.part(("world",)))
    return Experiment(config, file.resolve(), folder.resolve(), setting)


def run_experiment(
    experiment: Experiment, until: str | None = None, console: Console | None = None
) -> dict[str, StageRecord]:
    """Run the stages that are not there yet, and print the result of a finished experiment."""
    console = console or Console()
    began = time.monotonic()
    stages = stages_of(experiment)
    check_until(stages, until)
    experiment.folder.mkdir(parents=True, exist_ok=True)
    _write_manifest(experiment)
    with ProgressDisplay(console) as display:
        records = run_stages(stages, experiment.folder, display, until)
    if "report" in records:
        report.print_summary(experiment, console)
    console.print(f"{experiment.config.name} ({experiment.setting}): {time.monotonic() - began:.0f} s", highlight=False)
    return records


def stages_of(experiment: Experiment) -> list[Stage]:
    """The stages with the part of the configuration that each depends on; moving an object keeps capture, scene and object files."""
    config, world = experiment.config, experiment.world.model_dump(mode="json")
    measured = {
        "horizon": config.horizon,
        "dt_s": config.dt_s,
        "held_cap_m": config.held_cap_m,
        "scenarios": config.scenarios,
    }
    seen = {key: value for key, value in world.items() if key not in ("objects", "car")}
    kinds = sorted({thing.kind for thing in experiment.world.objects})

    def stage(name: str, module: Any, settings: dict[str, Any], after: Sequence[str]) -> Stage:
        def work(folder: Path, told: Report) -> None:
            module.run(experiment, folder, told)

        return Stage(name, work, json.loads(json.dumps(settings)), after)

    def part(name: str) -> Any:
        return getattr(config, name).model_dump(mode="json")

    stages = [
        stage("capture", capture, {"world": seen, "capture": part("capture"), **measured}, ()),
        stage("scene", scene, {"scene": part("scene")}, ("capture",)),
        stage("object", objects, {"object": part("object"), "kinds": kinds}, ()),
        stage("policy", policy, {"world": world, "policy": part("policy"), "sigma": config.attack.random_sigma, **measured}, ("capture", "scene", "object")),
        stage("attack", attack, {"world": world, "attack": part("attack"), **measured}, ("scene", "object", "policy")),
        stage("deploy", deploy, {"world": world, **measured}, ("object", "policy", "attack")),
        stage("report", report, {"attack": part("attack"), **measured}, ("capture", "scene", "policy", "attack", "deploy")),
    ]  # fmt: skip
    if config.retrain is not None:
        settings = {"world": world, "retrain": part("retrain"), "attack": part("attack"), **measured}
        stages.append(stage("retrain", retrain, settings, ("scene", "object", "policy", "attack")))
    return stages


def _write_manifest(experiment: Experiment) -> None:
    manifest = {
        "experiment": experiment.config.name,
        "setting": experiment.setting,
        "file": str(experiment.file),
        "command": " ".join(["advnerf", *sys.argv[1:]]),
        "config": experiment.config.model_dump(mode="json"),
        "versions": {"advnerf": version("advnerf"), "python": platform.python_version()}
        | {name: version(name) for name in _LIBRARIES},
    }
    write_atomically(experiment.folder / "manifest.json", json.dumps(manifest, indent=1) + "\n")
