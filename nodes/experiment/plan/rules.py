"""Rules between sections of the experiment file. Each raises a ValueError for a section that another one excludes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

from advnerf_core.attack.methods import METHODS, load_method, require_options
from advnerf_core.plugins import name_in_results
from nodes.experiment.plan.carriers import CarrierConfig, FaceCarrier
from nodes.experiment.plan.deploy_config import DeployConfig
from nodes.experiment.plan.object_kinds import OBJECT_SUFFIX, PANEL, name_of
from nodes.experiment.plan.placed import FLAT, PlacedObject, WantedObject
from nodes.experiment.plan.sections import AttackConfig, MeasureConfig, PolicyConfig, RetrainConfig
from nodes.experiment.plan.space_config import (
    ColoursConfig,
    MeshShapeConfig,
    MeshTextureConfig,
    PlacesConfig,
    SpaceConfig,
)
from nodes.experiment.plan.victims import RETRAINED, TrainingConfig, VictimConfig

_OPTIONS = "attack.options"


def _refuse(wrong: object, text: str) -> None:
    if wrong:
        raise ValueError(text)


def check_names(paths: Sequence[str], objects: Sequence[WantedObject]) -> None:
    """Raise for equal names among paths, objects and files of their kinds."""
    for what, names in (("paths", paths), ("names of objects", [each.name for each in objects])):
        _refuse(len(set(names)) != len(names), f"expected different {what}, got {', '.join(names)}")
    kinds = sorted({each.kind for each in objects})
    _refuse(
        len({name_of(kind).partition(".")[0] for kind in kinds}) != len(kinds),
        f"expected files of different names as kinds of objects, got {', '.join(kinds)}",
    )


def check_victims(
    attacked: Mapping[str, VictimConfig], trained: Mapping[str, TrainingConfig], retrain: RetrainConfig | None
) -> None:
    """Raise for victims that cannot be trained, or retrained: the first of ``attacked``."""
    main = next(iter(attacked))
    _refuse(
        RETRAINED in attacked,
        f"victims: expected other names than {RETRAINED}, which the section retrain makes, got it",
    )
    _refuse(
        any(one == other for one, other in combinations(trained.values(), 2)),
        f"victims: expected one victim for each way of training, got {', '.join(trained)}, of which two would be the same policy",
    )
    _refuse(
        retrain is not None and (main not in trained or trained[main].textures != "random"),
        f"expected the first of victims to be trained here with random textures where retrain is, got {main}",
    )


def check_face(
    carrier: FaceCarrier,
    space: SpaceConfig,
    objects: Sequence[WantedObject],
    deploy: DeployConfig,
    unwanted: Mapping[str, object],
) -> None:
    """Raise for anything else attacked beside a face; ``unwanted`` has further values that must not be present, by name."""
    there = {
        "space.kind colours": "" if isinstance(space, ColoursConfig) else space.kind,
        "no objects": ", ".join(each.name for each in objects),
        "no deploy.world": "" if deploy.world is None else deploy.world.get("kind"),
        **unwanted,
    }
    for wanted, found in there.items():
        _refuse(
            found,
            f"expected {wanted} with carrier.kind {carrier.kind}, which attacks one face on a panel of the captured world, got {found}",
        )


def check_objects(
    carrier: CarrierConfig, objects: Sequence[WantedObject], deploy: DeployConfig, retrains: bool
) -> None:
    """Raise for objects that the carrier cannot show."""
    voxels = [each.name for each in objects if each.kind.endswith(OBJECT_SUFFIX)]
    _refuse(
        deploy.live,
        f"expected carrier.kind overlay or screen, which the live nodes can show, with deploy.through nodes, got {carrier.kind}",
    )
    _refuse(
        "native" in (carrier.kind, carrier.training) and (voxels or not objects),
        f"expected panels and objects with a mesh in the world's own scene (carrier native), got {', '.join(voxels) or 'none'}; "
        f"of voxels (*{OBJECT_SUFFIX}) it has none: name the mesh itself (.glb)",
    )
    _refuse(
        carrier.response == "measured" and ([each.kind for each in objects] != [PANEL] or retrains),
        f"expected one panel and no retrain with carrier.response measured, got {', '.join(name_of(each.kind) for each in objects) or 'no objects'}"
        f"{' and retrain' * retrains}",
    )


def check_training(
    carrier: CarrierConfig, recipes: Mapping[str, PolicyConfig], objects: Sequence[WantedObject]
) -> None:
    """Raise for frames that victims cannot learn from."""
    by_hand = [each.name for each in objects if isinstance(each, PlacedObject)]
    for key, policy in recipes.items():
        _refuse(
            carrier.training == "native" and policy.own_car and policy.naive_steps,
            f"expected {key}.naive_steps 0 or {key}.own_car off with carrier.training native, got "
            f"{policy.naive_steps} and on: the world shows what was last put on a panel, so that the naive victim would learn from random textures",
        )
        _refuse(
            policy.learns_in and (by_hand or not objects or policy.own_car),
            f"expected objects that all stand by a rule (stands), and {key}.own_car off, with {key}.learns_in; got "
            f"{', '.join(by_hand) or f'{len(objects)} objects'} placed by hand, own_car {policy.own_car}",
        )


def check_space(
    space: SpaceConfig, objects: Sequence[WantedObject], attack: AttackConfig, deploy: DeployConfig
) -> None:
    """Raise for a space that does not fit the objects, the loss or the world of the deployment."""
    _check_smoothness(space, attack)
    own = [each.name for each in objects if isinstance(each, PlacedObject) and each.is_of_own_scenes]
    _refuse(
        own,
        "expected cubes, balls, and the keys face, mesh, levels, pitch_rad and roll_rad of objects only in a learned scene of your own (world: "
        f"{{kind: scene}}), got them of {', '.join(own)}",
    )
    if not isinstance(space, (MeshTextureConfig, MeshShapeConfig)):
        return
    kinds = [each.kind for each in objects]
    _refuse(PANEL in kinds, f"expected objects with a mesh with space.kind {space.kind}, got a panel")
    _refuse(
        any(kind.endswith(OBJECT_SUFFIX) for kind in kinds),
        f"expected objects with a mesh with space.kind {space.kind}, got voxels (*{OBJECT_SUFFIX}); name the mesh itself (.glb)",
    )
    _refuse(
        deploy.world is not None,
        f"expected space.kind colours or places with deploy.world, got {space.kind}, which is bound to the world that was captured",
    )


def check_own_scene(space: SpaceConfig, objects: Sequence[WantedObject], attack: AttackConfig) -> None:
    """Refuse what cannot be attacked in a learned scene of a user's own, for which nothing is built."""
    _check_smoothness(space, attack)
    things = [each for each in objects if isinstance(each, PlacedObject)]
    _refuse(
        not things or len(things) < len(objects),
        f"expected objects whose places are given (x_m, y_m, yaw_rad), got {len(objects) - len(things)} by a rule of {len(objects)}",
    )
    of_meshes = isinstance(space, (MeshTextureConfig, MeshShapeConfig))
    voxels = [each.name for each in things if each.kind in FLAT or each.kind.endswith(OBJECT_SUFFIX)]
    _refuse(
        of_meshes and voxels,
        f"expected objects with a mesh with space.kind {space.kind}, got {', '.join(voxels)}",
    )
    meshes = [each.name for each in things if each.mesh is not None]
    _refuse(
        isinstance(space, PlacesConfig) and meshes,
        f"expected objects made of voxels with space.kind places, got the mesh {', '.join(meshes)}; 'advnerf scene object build' makes voxels of it",
    )
    unbuilt = [
        f"{each.name} ({name_of(each.kind)})" for each in things if each.name not in (*voxels, *meshes)
    ]
    _refuse(
        unbuilt and not of_meshes,
        f"expected panels, cubes, files of 'advnerf scene object build' (*{OBJECT_SUFFIX}) or objects with the section mesh in a learned scene of your "
        f"own, got {', '.join(unbuilt)}; add mesh: {{}} to it",
    )
    shown = [each.name for each in things if each.face is not None and each.face.display is not None]
    _refuse(
        shown and (len(things) > 1 or attack.together or isinstance(space, PlacesConfig)),
        "face.display: expected one object, whose colours are searched, and seeds searched one after the other, got "
        f"{', '.join(each.name for each in things)} with space.kind {space.kind}",
    )


def _check_smoothness(space: SpaceConfig, attack: AttackConfig) -> None:
    _refuse(
        attack.robustness.smoothness and isinstance(space, (PlacesConfig, MeshShapeConfig)),
        f"expected attack.robustness.smoothness only where colours are searched, got it with space.kind {space.kind}",
    )


def check_methods(methods: Sequence[str], attack: AttackConfig, own_scene: bool) -> None:
    """Refuse options that no method has if all are built in (else see `check_options`), and seeds searched together without a gradient."""
    built_in = [name for name in methods if name in METHODS]
    if len(built_in) == len(methods):
        check_options(methods, attack)
    for name in built_in:
        METHODS[name].own_options(attack.options, _OPTIONS)
    _refuse(
        attack.together and (list(methods) != ["gradient"] or not own_scene),
        f"attack.together is for the gradient method only, in a learned scene of your own, got {', '.join(methods)}",
    )


def check_options(methods: Sequence[str], attack: AttackConfig) -> None:
    """Refuse options that none of the methods has; a user's method is loaded for it."""
    if methods and attack.options:
        found = {name_in_results(each): load_method(each) for each in methods}
        require_options(found, attack.options, _OPTIONS)


def check_searches(
    methods: Sequence[str], seeds: Sequence[int], measure: MeasureConfig, deploy: DeployConfig, retrains: bool
) -> None:
    """Raise for searches that use the measured starts, deployed starts that are not measured, and a retraining without its gradient."""
    _refuse(
        retrains and "gradient" not in methods,
        f"expected gradient among over.method, as retrain learns from what it finds, got {', '.join(methods)}",
    )
    _refuse(
        measure.seed in seeds,
        f"expected measure.seed to be none of over.seed, as no search may have the starts that are measured, got {measure.seed}",
    )
    _refuse(
        deploy.starts is not None and deploy.starts > measure.starts,
        f"expected deploy.starts to be at most measure.starts = {measure.starts}, of which it takes the first, got {deploy.starts}",
    )


def check_drives(
    attack: AttackConfig,
    recipes: Mapping[str, PolicyConfig],
    retrain: RetrainConfig | None,
    horizon: int,
    dt_s: float,
) -> None:
    """Refuse searched drives that are longer than the measured ones, and drives to learn from that end before the junction."""
    _refuse(
        attack.horizon is not None and attack.horizon > horizon,
        f"expected attack.horizon to be at most horizon = {horizon} ticks, which are measured, got {attack.horizon}",
    )
    asked = {} if retrain is None else {"retrain.drive_steps": retrain.drive_steps}
    # Of a closed path every part is passed.
    asked |= {
        f"{key}.drive_steps": each.drive_steps
        for key, each in recipes.items()
        if each.learns_from_drives and each.driven_m is not None
    }
    for key, ticks in asked.items():
        _refuse(
            2 * ticks < horizon,
            f"expected {key} to be at least half of horizon = {horizon} ticks, so that what is learned from passes the "
            f"junction too, got {ticks} ticks of dt_s = {dt_s:g} s, {ticks * dt_s:g} s; set {key}={horizon}",
        )
