"""Runs an experiment of kind ``intersection``: resolves its file, runs its stages, prints the table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from advnerf_core.attack.methods import method_digest, method_name
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.junction.config import IntersectionConfig
from nodes.experiment.junction import attack, capture, deploy, objects, policy, report, retrain, scene
from nodes.experiment.junction.config import IntersectionExperimentConfig
from nodes.experiment.junction.context import Experiment
from nodes.experiment.run import read_setting
from nodes.experiment.run_folder import run_to_end
from nodes.experiment.stages import Stage, StageRecord, begun_with
from nodes.runtime.config import validate
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report

_LIBRARIES = ("torch", "numpy", "numba", "opencv-contrib-python-headless", "mujoco")


def load_experiment(file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Experiment:
    """Resolve an experiment file.

    Args:
        file: A ``*.experiment.yaml`` file with ``kind: intersection`` or ``kind: carla``.
        setting: Which of its settings to lay over its values.
        overrides: ``section.key=value`` texts, applied last.
        folder: The run folder.

    Raises:
        ConfigError: With file, line and the valid keys.
    """
    document = read_setting(file, setting, overrides)
    config = validate(IntersectionExperimentConfig, document, file.parent)
    if config.kind == "carla":
        render = validate(CarlaConfig, document.part(("world",))).render
        try:
            render.whole_ticks(config.dt_s)
        except ValueError as error:
            raise ConfigError(
                f"{file}: expected dt_s to be whole ticks of world.render.fixed_delta_s = {render.fixed_delta_s:g} s, got {config.dt_s:g} s"
            ) from error
    else:
        validate(IntersectionConfig, document.part(("world",)))
    return Experiment(config, file.resolve(), folder.resolve(), setting)


def run_experiment(
    experiment: Experiment, until: str | None = None, console: Console | None = None
) -> dict[str, StageRecord]:
    """Run the stages that are not there yet, and print the result of a finished experiment."""
    summarise = partial(report.print_summary, experiment)
    return run_to_end(experiment, stages_of(experiment), _LIBRARIES, summarise, until, console)


def prepare_victims(experiment: Experiment, report: Report) -> None:
    """Make scene, objects and policies, also the retrained one where the experiment retrains.

    One round of it, if none is begun; rounds that were begun are gone on with, as many as were asked for then.
    """
    del report  # the stages show their own progress
    wanted = experiment.config.retrain
    if wanted is None:
        run_experiment(experiment, until="policy")
        return
    begun = begun_with(stages_of(experiment), experiment.folder, "retrain")
    if begun is not None and policy.victim_file(experiment, policy.RETRAINED).exists():
        return
    # Its victim is that of the first round: the others are left to the experiment itself, which goes on from here.
    rounds = 1 if begun is None else begun["retrain"]["rounds"]
    config = experiment.config.model_copy(update={"retrain": wanted.model_copy(update={"rounds": rounds})})
    run_experiment(replace(experiment, config=config), until="retrain")
    if not policy.victim_file(experiment, policy.RETRAINED).exists():
        raise ConfigError(
            f"expected a retrained policy in {experiment.stage_folder('retrain')}, got none: no attack reaches retrain.pays_ratio = "
            f"{wanted.pays_ratio:g} (see retrain.json there), so nothing was retrained; lower it, or leave the victim retrained out of the campaign"
        )


def stages_of(experiment: Experiment) -> list[Stage]:
    """The stages with the part of the configuration that each depends on; moving an object keeps capture, scene and object files.

    More rounds of retraining go on from those that are there.
    """
    config, world = experiment.config, experiment.site.settings
    measured = {
        "horizon": config.horizon,
        "dt_s": config.dt_s,
        "held_cap_m": config.held_cap_m,
        "scenarios": config.scenarios,
    }
    seen = {key: value for key, value in world.items() if key not in ("objects", "car")}
    # Held-out views lie along what is driven. Only another speed than the usual one is named: captures of before stay what they are.
    speed_mps, car = experiment.world.car.speed_mps, type(experiment.world.car)
    other_speed = {} if speed_mps == car.model_fields["speed_mps"].default else {"speed_mps": speed_mps}
    kinds = sorted({thing.kind for thing in experiment.world.objects})

    def stage(
        name: str, module: Any, settings: dict[str, Any], after: Sequence[str], parts: Sequence[dict[str, Any]] = ()
    ) -> Stage:
        def work(folder: Path, told: Report) -> None:
            module.run(experiment, folder, told)

        settings, *smaller = json.loads(json.dumps([settings, *parts]))
        return Stage(name, work, settings, after, goes_on_from=smaller)

    def part(name: str) -> Any:
        return getattr(config, name).model_dump(mode="json")

    # Of users' methods the code counts, not where it is.
    searched = {**part("attack"), "methods": config.attack.method_names}
    if codes := {method_name(each): code for each in config.attack.methods if (code := method_digest(each))}:
        searched["code"] = codes

    stages = [
        stage("capture", capture, {"world": seen, "capture": part("capture"), **measured, **other_speed}, ()),
        stage("scene", scene, {"scene": part("scene")}, ("capture",)),
        stage("object", objects, {"object": part("object"), "kinds": kinds}, ()),
        stage("policy", policy, {"world": world, "policy": part("policy"), "sigma": config.attack.random_sigma, **measured}, ("capture", "scene", "object")),
        stage("attack", attack, {"world": world, "attack": searched, "space": part("space"), **measured}, ("scene", "object", "policy")),
        stage("deploy", deploy, {"world": world, "space": part("space"), **measured}, ("object", "policy", "attack")),
        stage("report", report, {"attack": searched, **measured}, ("capture", "scene", "policy", "attack", "deploy")),
    ]  # fmt: skip
    if config.retrain is not None:
        settings = {"world": world, "retrain": part("retrain"), "attack": searched, **measured}
        fewer = [
            {**settings, "retrain": {**settings["retrain"], "rounds": rounds}}
            for rounds in range(1, config.retrain.rounds)
        ]
        stages.append(stage("retrain", retrain, settings, ("scene", "object", "policy", "attack"), fewer))
    return stages
