"""Resolves experiment files, and runs the stages that cells need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from advnerf_core.documents import Document
from advnerf_core.plugins import unknown
from advnerf_core.run_module import search_folder_last
from hardware.worlds.world import NativeMeshes, NativePanels, Photographed
from nodes.experiment.engine.artefact import REFERENCE
from nodes.experiment.engine.run_folder import require_own_folder, write_manifest
from nodes.experiment.engine.stages import begun_with, run_stages, stage_digests
from nodes.experiment.plan.carriers import ComposedConfig, FaceCarrier, NativeConfig, ScreenConfig
from nodes.experiment.plan.object_kinds import PANEL
from nodes.experiment.plan.placed import PlacedObject, in_a_lane
from nodes.experiment.plan.victims import RETRAINED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.experiment_world import NotCapturedError
from nodes.experiment.show.given import VictimUnknownError, given_in, victim_spec
from nodes.experiment.show.kept_worlds import WorldUnknownError, is_users, keep_worlds
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.keys import without_solids
from nodes.experiment.steps.live import check_live
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.retrain import pays_from_m
from nodes.lab.worlds.named import known_kind, read_world
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay, StageDisplay

_WHOLE_STEP_S = 1e-6


def load_experiment(
    file: Path, setting: str | None, overrides: Sequence[str], folder: Path | None, executes: bool = True
) -> Experiment:
    """Resolve an experiment file and its variants.

    Args:
        file: A ``*.experiment.yaml`` file.
        setting: Name of the setting to lay over its values; None uses demo if it has settings.
        overrides: ``section.key=value`` texts, applied last.
        folder: The run folder; None uses the file's ``run_folder``, or else one under ``runs``.
        executes: Whether a user's world may be executed; else the file's values are not checked against that world.

    Raises:
        ConfigError: The file is wrong; with file, line and the valid keys.
    """
    return Experiment.resolved(file, setting, overrides, folder, executes, _load)


def _load(experiment: Experiment, document: Document) -> Experiment:
    """An experiment without variants, checked against its world, with the digests of its stages that are stored with the code."""
    experiment = experiment.with_given_scene()
    for section in (("world",), *([("deploy", "world")] if experiment.config.deploy.world else [])):
        known_kind(document.part(section), experiment.file.parent)
    if experiment.executes or not is_users(experiment.config.world):
        _check_world(experiment, document)
    if given_in(experiment.config):
        search_folder_last(
            str(experiment.file.parent)
        )  # package.module:factory may be beside the experiment file
    try:
        stages = stages_of(experiment)
    except (VictimUnknownError, WorldUnknownError, NotCapturedError):
        return experiment  # it was never run with its victims or its world
    return replace(experiment, kept=stage_digests(stages, experiment.folder, REFERENCE))


def _check_world(experiment: Experiment, document: Document) -> None:
    """Raise for values that do not fit the world, with the line of the file."""
    read_world(document.part(("world",)), experiment.file.parent)
    _check_ticks(experiment, document)
    _check_objective(experiment, document)
    _check_native(experiment, document)
    if experiment.config.deploy.live:
        check_live(experiment, document.place(("deploy",)))
    if experiment.is_described:
        _check_places(experiment, document)


def _check_ticks(experiment: Experiment, document: Document) -> None:
    """Check that a control tick is a whole number of the world's steps."""
    step_s, dt_s = experiment.traits.step_s, experiment.config.dt_s
    if step_s is not None and abs(round(dt_s / step_s) * step_s - dt_s) > _WHOLE_STEP_S:
        raise ConfigError(
            f"{document.place(('dt_s',))}: expected dt_s to be whole steps of the world {experiment.named_world.kind}, {step_s:g} s each, "
            f"got {dt_s:g} s"
        )


def _check_objective(experiment: Experiment, document: Document) -> None:
    """Check that the objective collision has a world with obstacles; users' objectives are checked before any stage."""
    if experiment.config.attack.objective == "collision" and experiment.solids is None:
        raise ConfigError(f"{document.place(('attack', 'objective'))}: {without_solids(experiment)}")


def _check_native(experiment: Experiment, document: Document) -> None:
    """Check that worlds take the objects that stand in their own scenes: while victims learn, and in the deployed drive."""
    config = experiment.config
    wanted = (
        (NativePanels, "add_panel", [each.name for each in config.objects if each.kind == PANEL]),
        (NativeMeshes, "add_mesh", [each.name for each in config.objects if each.kind != PANEL]),
    )
    uses = {}
    if config.carrier.training == "native":
        uses["training"] = experiment.named_world
    if isinstance(config.carrier, NativeConfig):
        uses["kind"] = experiment.deployed_world
    for key, world in uses.items():
        made = world.make()
        for kind, call, names in wanted:
            if names and not isinstance(made, kind):
                raise ConfigError(
                    f"{document.place(('carrier',))}: expected a world that takes {', '.join(names)} into its own scene ({call}) with "
                    f"carrier.{key} native, got {world.kind}; set carrier.{key}=composed"
                )


def _check_places(experiment: Experiment, document: Document) -> None:
    """Check that paths exist in the world, and objects stand beside its lanes; errors have the line of the file."""
    for index, name in enumerate(experiment.config.paths):
        if name not in experiment.world.paths:
            message = unknown(name, "path", experiment.world.paths)
            raise ConfigError(f"{document.place(('paths', index))}: paths: {message}")
    _check_start_sigma(experiment, document)
    _check_start_poses(experiment, document)
    if experiment.config.own_scene or isinstance(experiment.named_world.make(), Photographed):
        _check_undriven(experiment, document)
    by_hand = [
        index for index, each in enumerate(experiment.config.objects) if isinstance(each, PlacedObject)
    ]
    _ = experiment.searched_dynamics
    if not experiment.config.own_scene and (found := in_a_lane(experiment.placed_by_hand, experiment.world)):
        raise ConfigError(f"{document.place(('objects', by_hand[found[0]]))}: {found[1]}")
    if isinstance(carrier := experiment.config.carrier, FaceCarrier):
        _check_panel(carrier, experiment, document)
    if experiment.traits.own_photo_colours and not experiment.config.capture.colour_pairs:
        raise ConfigError(
            f"{document.place(('capture',))}: expected capture.colour_pairs of at least 1, as the photographs of the world "
            f"{experiment.named_world.kind} have colours of their own, got 0; 12 will do"
        )
    if not given_in(experiment.config):  # existing policies are checked when the experiment is run
        _ = experiment.view


def _check_start_sigma(experiment: Experiment, document: Document) -> None:
    """Check that drawn starts are on the track, but for one in twenty."""
    sigma, limit_m = experiment.config.attack.start_sigma, experiment.world.off_track_m
    if sigma > 0.5 * limit_m:
        raise ConfigError(
            f"{document.place(('attack', 'start_sigma'))}: expected attack.start_sigma to be at most half of the off-track limit, "
            f"{limit_m:g} m, got {sigma:g}; with more, drives begin off the track"
        )


def _check_start_poses(experiment: Experiment, document: Document) -> None:
    """Check that given starts are on the track of every path that is driven."""
    poses, limit_m = experiment.config.attack.start_poses, experiment.world.off_track_m
    for index, (x_m, y_m, _) in enumerate(poses):
        for name in experiment.config.cell_paths:
            cte_m = float(experiment.paths[name].project((x_m, y_m)).cte_m)
            if abs(cte_m) > limit_m:
                raise ConfigError(
                    f"{document.place(('attack', 'start_poses', index))}: expected attack.start_poses on the track, at most {limit_m:g} m from the "
                    f"middle of the path {name}, got x = {x_m:g} m, y = {y_m:g} m, which is {abs(cte_m):.2f} m from it; give them in metres, as the path"
                )


def _check_panel(carrier: FaceCarrier, experiment: Experiment, document: Document) -> None:
    """Check that the panel of a face exists in the world, and is a screen exactly if a screen shows the face."""
    panels = experiment.world.panels
    if carrier.panel not in panels:
        message = unknown(carrier.panel, "panel", panels)
        raise ConfigError(f"{document.place(('carrier', 'panel'))}: carrier.panel: {message}")
    has_screen = panels[carrier.panel].screen_px is not None
    if has_screen != isinstance(carrier, ScreenConfig):
        raise ConfigError(
            f"{document.place(('carrier', 'kind'))}: expected carrier.kind {'screen' if has_screen else 'overlay'} with the panel "
            f"{carrier.panel}, which is {'a' if has_screen else 'no'} screen, got {carrier.kind}"
        )


def _check_undriven(experiment: Experiment, document: Document) -> None:
    """Nothing drives in a place that is known by photographs or by a learned scene alone: policies must exist, and objects stand by hand."""
    config, what = experiment.config, "a learned scene" if experiment.config.own_scene else "photographs"
    refused: list[tuple[tuple[str, ...], bool, str]] = [
        (("deploy", "through"), config.deploy.through != "nothing", "deploy.through nothing"),
        (("victims",), bool(config.trained), "victims that exist ({policy: ...})"),
        (
            ("objects",),
            experiment.has_rules,
            "objects whose places are given (x_m, y_m, yaw_rad)",
        ),
        (("capture", "colour_pairs"), config.capture.colour_pairs > 0, "capture.colour_pairs 0"),
        (("carrier",), config.carrier != ComposedConfig(kind="composed"), "carrier {kind: composed}"),
    ]
    if config.own_scene:
        refused.append((("gate",), config.gate is not None, "gate null"))
    else:
        over_pictures = config.space.kind not in ("colours", "places")
        refused.append((("space", "kind"), over_pictures, "space.kind colours or places"))
    for key, wrong, wanted in refused:
        if wrong:
            raise ConfigError(
                f"{document.place(key)}: expected {wanted} in a place that is known by {what} alone, as nothing can be driven or "
                "photographed there"
            )


def make_ready(
    experiment: Experiment,
    until: str | None = None,
    console: Console | None = None,
    anew: bool = False,
    watcher: StageDisplay | None = None,
) -> None:
    """Load existing victims, and run the unfinished stages that cells need. Stages stored with the code count as finished, unless
    ``anew`` is set.

    Raises:
        ConfigError: The folder has the stages of another experiment, which would be replaced.
        AdvnerfError: A stage failed, or the policy's architecture cannot be built.
    """
    require_own_folder(experiment)
    look_at_given(experiment)
    keep_worlds(experiment.folder, experiment.named_worlds)
    for each in experiment.config.trained.values():
        each.network.check()
    stages, last = stages_of(experiment), None if experiment.config.own_scene else until
    write_manifest(experiment)
    with ProgressDisplay(console, watcher) as display:
        run_stages(stages, experiment.folder, display, last, None if anew else REFERENCE)


def prepare_victims(experiment: Experiment) -> None:
    """Make scene, objects and policies, also the retrained one if the experiment retrains.

    One round of retraining, if none was begun; begun rounds are resumed, with the number requested then.
    """
    wanted = experiment.config.retrain
    if wanted is None:
        last = [experiment.config.policy_stage(name) for name in experiment.config.trained][-1:]
        make_ready(experiment, until=last[0] if last else "object")
        return
    begun = begun_with(stages_of(experiment), experiment.folder, "retrain")
    if begun is not None and Path(victim_spec(experiment, RETRAINED)).exists():
        return
    # Its victim is the first round's: the others are left to the experiment itself, which resumes from here.
    rounds = 1 if begun is None else begun.resolved["retrain"]["rounds"]
    config = experiment.config.model_copy(update={"retrain": wanted.model_copy(update={"rounds": rounds})})
    make_ready(replace(experiment, config=config), until="retrain")
    if not Path(victim_spec(experiment, RETRAINED)).exists():
        raise ConfigError(
            f"expected a retrained policy in {experiment.stage_folder('retrain')}, got none: no attack costs more than retrain.pays_m = "
            f"{pays_from_m(experiment):g} m per tick (see retrain.json there), so nothing was retrained; lower it, or leave the victim retrained out"
        )
