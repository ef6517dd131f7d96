"""The stages of an experiment: the parts of the experiment file that each reads, its other inputs, and its version."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from advnerf_core.attack.objectives import objective_key
from advnerf_core.splats.scene_file import load_hash
from nodes.experiment.engine.artefact import Settings
from nodes.experiment.engine.stages import Stage
from nodes.experiment.plan.carriers import ScreenConfig
from nodes.experiment.plan.object_kinds import files_of, is_mesh, name_of
from nodes.experiment.plan.sections import NETWORK, UNBOUNDED, SceneConfig
from nodes.experiment.plan.victims import RETRAINED
from nodes.experiment.show import objects
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import has_face
from nodes.experiment.show.given import given_in, victim_sha256
from nodes.experiment.show.learned_scene import VIEWS
from nodes.experiment.steps import bake, capture, live, policy, retrain, scene
from nodes.runtime.progress import MeasuringReport

# Raised when the output of a stage changes with the same settings, or a default that it reads does: then its old results, and all that build
# on them, are made again. tests/nodes/experiment/test_versions.py fails where one of them changed and the version did not.
VERSIONS = {"capture": 1, "scene": 3, "bake": bake.VERSION, "object": 2, "policy": 2, "retrain": 3, "live": 1}
# Parts of the experiment file that a stage may read, as `BaseModel.model_dump` includes them; its key has no others. Worlds,
# views, and users' code and files are inputs.
_CARRIER: dict[str, Any] = {"carrier": {"kind", "panel", "plain_rgb", "resolution", "response"}}
_OBJECTS: dict[str, Any] = {"objects": True, "object": {"panel_resolution", "panel_rgb"}}
_DRIVE: dict[str, Any] = {"paths": True, "horizon": True, "dt_s": True}
READS: Mapping[str, dict[str, Any]] = {
    "capture": {"capture": True, "objects": True, **_CARRIER, **_DRIVE},
    "scene": {"scene": set(SceneConfig.model_fields) - UNBOUNDED, "capture": {"colour_pairs"}},
    "bake": {"measure": {"scene"}, "scene": UNBOUNDED, **_DRIVE},
    "object": {"object": {"car_resolution", "hydrant_resolution", "mesh_resolution", "fit_steps"}},
    "policy": {"policy": True, "attack": {"random_sigma"}, **_CARRIER, **_OBJECTS, **_DRIVE},
    "retrain": {
        **dict.fromkeys(("retrain", "policy", "space", "attack", "held_cap_m"), True),
        "deploy": {"car", "camera"},
        "measure": {"starts", "seed"},
        **_CARRIER,
        **_OBJECTS,
        **_DRIVE,
    },
    "live": {
        "deploy": {"nodes", "camera", "calibration", "changes", "laps", "empty_scene"},
        "held_cap_m": True,
        **_CARRIER,
        **_DRIVE,
    },
}
# Settings that the defence does not read of the first seed's gradient, which it answers; the objective is an input.
_UNREAD_BY_RETRAIN: dict[str, Any] = {
    "carrier": {"kind"},
    "policy": NETWORK,
    "attack": {"objective", "population", "cache_mib"},
}
# Training files of policies, besides the results.
_TRAINING_FILES = ("frames", "*.checkpoint.safetensors", "*.shards.json", "settings.json")


def stages_of(experiment: Experiment) -> list[Stage]:
    """All stages; the world must not have been opened for them."""
    config, found = experiment.config, stages_of_cells(experiment)
    if config.deploy.live and (config.deploy.laps or config.deploy.empty_scene):
        found.append(_live(experiment))
    return found


def stages_of_cells(experiment: Experiment) -> list[Stage]:
    """The stages that cells need. A scene of the user's own is only baked.

    More rounds of retraining resume from the existing ones.
    """
    config = experiment.config
    if config.own_scene:
        return [_bake_own(experiment, Path(str(experiment.named_world.config.file)))]
    found = [_capture(experiment), _scene(experiment), _bake(experiment), _object(experiment)]
    by_stage = {config.policy_stage(name): name for name in config.trained}
    found += [
        _policy(stage, replace(experiment, config=config.training(name))) for stage, name in by_stage.items()
    ]
    if config.retrain is not None:
        found.append(_retrain(experiment, config.retrain.rounds))
    return found


def _stage(
    name: str,
    run: Callable[[Experiment, Path, MeasuringReport], None],
    experiment: Experiment,
    settings: Settings,
    after: Sequence[str] = (),
    **others: Any,
) -> Stage:
    return Stage(name, partial(run, experiment), settings, after, VERSIONS[name.partition("-")[0]], **others)


def _capture(experiment: Experiment) -> Stage:
    config = experiment.config
    unread: dict[str, Any] = {"carrier": {"resolution"}}
    inputs = {"world": experiment.seen_settings}
    # The picture of a screen is photographed; an overlay is drawn into pictures later.
    if not isinstance(config.carrier, ScreenConfig):
        unread["carrier"] = {"kind", "panel", "plain_rgb", "resolution"}
    # A rule follows the measured drive; so does the search for the light on a panel.
    if experiment.has_rules or config.carrier.response == "measured":
        inputs["view"] = experiment.view_settings
    else:
        unread |= dict.fromkeys(("objects", "horizon", "dt_s"), True)
    settings = Settings.of(config, READS["capture"], unread, **inputs)
    return _stage("capture", capture.run, experiment, settings, bulk=(capture.PHOTOS, capture.COLOUR_PAIRS))


def _scene(experiment: Experiment) -> Stage:
    settings = Settings.of(experiment.config, READS["scene"], view=experiment.view_settings)
    return _stage(
        "scene", scene.run, experiment, settings, ("capture",), bulk=(VIEWS,), reads_bulk_of=("capture",)
    )


def _bake(experiment: Experiment) -> Stage:
    settings = Settings.of(experiment.config, READS["bake"], view=experiment.view_settings)
    return _stage("bake", bake.run, experiment, settings, ("capture", "scene"))


def _bake_own(experiment: Experiment, file: Path) -> Stage:
    inputs = {"view": experiment.view_settings, "scene": load_hash(file), "world": experiment.world_settings}
    settings = Settings.of(experiment.config, READS["bake"], {"measure": True, "scene": True}, **inputs)
    return _stage("bake", bake.run, experiment, settings)


def _object(experiment: Experiment) -> Stage:
    kinds = sorted({thing.kind for thing in experiment.config.objects}, key=name_of)
    # Objects built before the front of glTF counted have another yaw.
    axes = {"mesh_front": "+z for y up"} if any(map(is_mesh, kinds)) else {}
    settings = Settings.of(
        experiment.config, READS["object"], kinds=list(map(name_of, kinds)), files=files_of(kinds), **axes
    )
    return _stage("object", objects.run, experiment, settings)


def _learned_from(experiment: Experiment) -> dict[str, Any]:
    """Inputs of results that are learned from pictures of the world and of the learned scene."""
    return {
        "world": experiment.world_settings,
        "view": experiment.view_settings,
        # Without the digest of the baked scene, as machines differ in its last bits.
        "bake": VERSIONS["bake"],
        **experiment.config.scene.model_dump(include=UNBOUNDED, exclude_defaults=True),
        "architecture": experiment.config.policy.network.described(),
        # Its default differs between carriers, and it does not matter how the deployed drive shows objects.
        "training": experiment.config.carrier.training,
    }


def _policy(name: str, experiment: Experiment) -> Stage:
    config = experiment.config
    unread: dict[str, Any] = {"policy": NETWORK}
    unread |= dict.fromkeys(("objects", "object"), True) if has_face(experiment) else {"carrier": {"kind"}}
    # The viewing angle of a screen follows the measured drive, and so do rules in other places.
    if not (isinstance(config.carrier, ScreenConfig) or config.policy.learns_in):
        unread["horizon"] = True
    settings = Settings.of(config, READS["policy"], unread, **_learned_from(experiment))
    return _stage(
        name, policy.run, experiment, settings, ("capture", "scene", "object"), bulk=_TRAINING_FILES
    )


def _retrain(experiment: Experiment, rounds: int) -> Stage:
    config = experiment.config.training(RETRAINED)
    trained_in = experiment.config.policy_stage(RETRAINED)

    def settings(count: int) -> Settings:
        assert config.retrain is not None
        fewer = config.retrain.model_copy(update={"rounds": count})
        return Settings.of(
            config.model_copy(update={"retrain": fewer}),
            READS["retrain"],
            _UNREAD_BY_RETRAIN,
            objective=objective_key(config.attack.objective),
            attack_seed=config.seeds[0],
            **_learned_from(replace(experiment, config=config)),
        )

    return _stage(
        "retrain",
        retrain.run,
        experiment,
        settings(rounds),
        ("scene", "object", trained_in),
        resumes_from=[settings(fewer) for fewer in range(1, rounds)],
        reads_bulk_of=(trained_in,),
    )


def _live(experiment: Experiment) -> Stage:
    config, main = experiment.config, experiment.config.main_victim
    is_given = main in given_in(config)
    settings = Settings.of(
        config,
        READS["live"],
        world=experiment.world_settings,
        graph=experiment.graph,
        victim=victim_sha256(experiment, main) if is_given else main,
    )
    after = ("capture",) if is_given else ("capture", config.policy_stage(main))
    return _stage("live", live.run, experiment, settings, after)
