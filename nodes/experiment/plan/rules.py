"""Rules between sections of the experiment file: what one section may hold, given another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from nodes.experiment.plan.carriers import CarrierConfig, ComposedConfig, FaceCarrier, NativeConfig
from nodes.experiment.plan.deploy_config import DeployConfig
from nodes.experiment.plan.object_kinds import OBJECT_SUFFIX, PANEL, name_of
from nodes.experiment.plan.placed import PlacedObject, WantedObject
from nodes.experiment.plan.sections import AttackConfig, PolicyConfig, RetrainConfig
from nodes.experiment.plan.space_config import (
    ColoursConfig,
    MeshShapeConfig,
    MeshTextureConfig,
    PlacesConfig,
    SpaceConfig,
)
from nodes.experiment.plan.victims import RETRAINED, TRAINED, TRAINED_PLAIN, TrainedVictim, VictimConfig


def check_names(paths: Sequence[str], objects: Sequence[WantedObject]) -> None:
    """Paths, objects and the files of their kinds have different names.

    Raises:
        ValueError: Two have the same name.
    """
    for what, names in (("paths", paths), ("names of objects", [each.name for each in objects])):
        if len(set(names)) != len(names):
            raise ValueError(f"expected different {what}, got {', '.join(names)}")
    kinds = {each.kind for each in objects}
    if len({name_of(kind).partition(".")[0] for kind in kinds}) != len(kinds):
        raise ValueError(
            f"expected files of different names as kinds of objects, got {', '.join(sorted(kinds))}"
        )


def check_victims(
    attacked: Mapping[str, VictimConfig], policy: PolicyConfig, retrain: RetrainConfig | None
) -> None:
    """Victims can be made: each way of training once, and the first one can be retrained.

    Args:
        attacked: All victims but the retrained one, the main one first.
        policy: How those that are trained are trained.
        retrain: How the main one is retrained.

    Raises:
        ValueError: One of them cannot.
    """
    if RETRAINED in attacked:
        raise ValueError(
            f"victims: expected other names than {RETRAINED}, which the section retrain makes, got it"
        )
    trained = {name: each for name, each in attacked.items() if isinstance(each, TrainedVictim)}
    if len({each.train.textures for each in trained.values()}) != len(trained):
        raise ValueError(
            f"victims: expected one victim for each way of training, got {', '.join(trained)}, of which two would be the same policy"
        )
    if TRAINED_PLAIN in trained.values() and not policy.naive_steps:
        raise ValueError(
            "expected policy.naive_steps of at least 1 with a victim of train.textures none, got 0"
        )
    main = next(iter(attacked))
    if retrain is not None and attacked[main] != TRAINED:
        raise ValueError(
            f"expected the first of victims to be trained here with random textures where retrain is, got {main}"
        )


def check_carrier(
    carrier: CarrierConfig,
    space: SpaceConfig,
    objects: Sequence[WantedObject],
    deploy: DeployConfig,
    no_object: bool,
    retrains: bool,
) -> None:
    """What shows the texture fits what is attacked: a face alone, or objects.

    Args:
        carrier: What shows the texture.
        space: What is searched.
        objects: What is attacked, unless it is a face.
        deploy: What drives.
        no_object: Whether there is the control empty, without objects.
        retrains: Whether the victim is retrained.

    Raises:
        ValueError: It does not.
    """
    if isinstance(carrier, FaceCarrier):
        there = {
            "space.kind colours": "" if isinstance(space, ColoursConfig) else space.kind,
            "no objects": ", ".join(each.name for each in objects),
            "no retrain": "it" * retrains,
            "no control empty in over.method (set deploy.empty_scene instead)": "it" * no_object,
            "no deploy.world": "" if deploy.world is None else str(deploy.world.get("kind")),
        }
        for wanted, found in there.items():
            if found:
                raise ValueError(
                    f"expected {wanted} with carrier.kind {carrier.kind}, which attacks one face on a panel of the captured world, got {found}"
                )
        return
    if deploy.live:
        raise ValueError(
            f"expected carrier.kind overlay or screen, which the live nodes can show, with deploy.through nodes, got {carrier.kind}"
        )
    _check_panels(carrier, objects)
    if carrier.response == "measured" and (len(objects) != 1 or retrains):
        raise ValueError(
            f"expected one panel and no retrain with carrier.response measured, got {len(objects)} objects{' and retrain' * retrains}"
        )


def _check_panels(carrier: ComposedConfig | NativeConfig, objects: Sequence[WantedObject]) -> None:
    if "native" in (carrier.kind, carrier.training):
        others = [each.name for each in objects if each.kind != PANEL]
        if others or not objects:
            raise ValueError(
                f"expected objects of kind panel alone with panels in the world's own scene (carrier native), got {', '.join(others) or 'none'}"
            )


def check_training(carrier: CarrierConfig, policy: PolicyConfig, objects: Sequence[WantedObject]) -> None:
    """Victims can learn from the frames that are asked for.

    Raises:
        ValueError: They cannot.
    """
    native = isinstance(carrier, ComposedConfig | NativeConfig) and carrier.training == "native"
    if native and policy.own_car and policy.naive_steps:
        raise ValueError(
            "expected policy.naive_steps 0 or policy.own_car off with carrier.training native, got "
            f"{policy.naive_steps} and on: the world shows what was last put on a panel, so that the naive victim would learn from random textures"
        )
    by_hand = [each.name for each in objects if isinstance(each, PlacedObject)]
    if policy.learns_in and (by_hand or not objects or policy.own_car):
        raise ValueError(
            "expected objects that all stand by a rule (stands), and policy.own_car off, with policy.learns_in; got "
            f"{', '.join(by_hand) or f'{len(objects)} objects'} placed by hand, own_car {policy.own_car}"
        )


def check_space(
    space: SpaceConfig, objects: Sequence[WantedObject], attack: AttackConfig, deploy: DeployConfig
) -> None:
    """What is searched fits the objects, the loss and the world where it is deployed.

    Raises:
        ValueError: It does not.
    """
    if isinstance(space, (MeshTextureConfig, MeshShapeConfig)):
        kinds = [each.kind for each in objects]
        if PANEL in kinds:
            raise ValueError(f"expected objects with a mesh with space.kind {space.kind}, got a panel")
        if any(kind.endswith(OBJECT_SUFFIX) for kind in kinds):
            raise ValueError(
                f"expected objects with a mesh with space.kind {space.kind}, got voxels (*{OBJECT_SUFFIX}); name the mesh itself (.glb)"
            )
        if deploy.world is not None:
            raise ValueError(
                f"expected space.kind colours or places with deploy.world, got {space.kind}, which is bound to the world that was captured"
            )
    if attack.robustness.smoothness and isinstance(space, (PlacesConfig, MeshShapeConfig)):
        raise ValueError(
            f"expected attack.robustness.smoothness only where colours are searched, got it with space.kind {space.kind}"
        )


def check_searches(
    methods: Sequence[str], seeds: Sequence[int], measured_seed: int, retrain: RetrainConfig | None
) -> None:
    """Searches do not see the measured starts, and retraining has its gradient.

    Raises:
        ValueError: They do, or it has not.
    """
    if retrain is not None and "gradient" not in methods:
        raise ValueError(
            f"expected gradient among over.method, as retrain learns from what it finds, got {', '.join(methods)}"
        )
    if measured_seed in seeds:
        raise ValueError(
            f"expected measure.seed to be none of over.seed, as no search may have the starts that are measured, got {measured_seed}"
        )


def check_drives(
    attack: AttackConfig, policy: PolicyConfig, retrain: RetrainConfig | None, horizon: int, dt_s: float
) -> None:
    """Searched drives end with the measured ones, and those that are learned from last long enough.

    Raises:
        ValueError: They are too long, or too short.
    """
    if attack.horizon is not None and attack.horizon > horizon:
        raise ValueError(
            f"expected attack.horizon to be at most horizon = {horizon} ticks, which are measured, got {attack.horizon}"
        )
    # Fine ticks with the default number of them would end before the junction.
    asked = {}
    learns_from_drives = policy.dagger_rounds and (policy.deployed_drives or policy.surrogate_drives)
    if learns_from_drives and policy.driven_m is not None:  # of a closed path every part is passed
        asked["policy.drive_steps"] = policy.drive_steps
    if retrain is not None:
        asked["retrain.drive_steps"] = retrain.drive_steps
    for key, ticks in asked.items():
        if 2 * ticks < horizon:
            raise ValueError(
                f"expected {key} to be at least half of horizon = {horizon} ticks, so that what is learned from passes the "
                f"junction too, got {ticks} ticks of dt_s = {dt_s:g} s, {ticks * dt_s:g} s; set {key}={horizon}"
            )
