"""Stage policy: one goal-conditioned network learns all drives, from the deployment scene and the surrogate or in training worlds, by DAgger."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.attack.spaces.space import FaceSpace
from advnerf_core.data.image_files import write_image
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.view_loading import load_image
from advnerf_core.driving.path import Array
from advnerf_core.driving.rollout import Remembering
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.files import write_json
from advnerf_core.geometry import planar_pose
from advnerf_core.learning.imitation import ImitationProgress, Learned, train_policy
from advnerf_core.learning.recipe import ImitationConfig, SourcePlan
from advnerf_core.learning.sources import FrameSource, RenderedSource, SceneSource, Show
from advnerf_core.policies.network import Policy, images_to_tensor, tensor_to_images
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.scene.remembered import RememberedBackground, frame_bytes
from hardware.worlds.world import World
from nodes.experiment.plan.victims import HARDENED, NAIVE
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed, seen_in
from nodes.experiment.show.faces import PaintedScene, face_object, face_space, has_face
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.show.light import light_on_panels
from nodes.experiment.show.native import stand_in
from nodes.experiment.show.objects import (
    describe,
    placed_objects,
    random_textures,
    surrogate_of,
)
from nodes.experiment.show.victims import told
from nodes.experiment.steps import capture
from nodes.experiment.steps.elsewhere import plans_elsewhere
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import MeasuringReport, Point

# Poses for training: as far from the path [m, for half a lane of 1.75 m] as a recovery may have to begin.
_STILLS_M, _DRIVES_M, _GIVE_UP_M = 1.6, 0.8, 3.0
# Pixels of a face in training: as many as its nearest view has.
_TRAINING_TEXTURE_PX = 128
_KEPT_FRAMES = 64  # of the learned scene: more than any batch of a source

Sample = Callable[[np.random.Generator], torch.Tensor]


def run(
    experiment: Experiment, folder: Path, report: MeasuringReport, number_type: torch.dtype | None = None
) -> None:
    """Train the victims, then compare their controls on held-out views and on the surrogate's image of them.

    Args:
        number_type: See `advnerf_core.learning.fit.fit`.
    """
    config = experiment.config.policy
    settings = ImitationConfig(
        seed=config.seed,
        dagger_rounds=config.dagger_rounds,
        first_steps=config.first_steps,
        round_steps=config.round_steps,
        naive_steps=config.naive_steps,
        architecture=config.network,
        lateral_m=experiment.across_m(_STILLS_M),
        heading_rad=config.stills_heading_rad,
        drive_lateral_m=experiment.across_m(_DRIVES_M),
        drive_heading_rad=config.drives_heading_rad,
        give_up_m=experiment.across_m(_GIVE_UP_M),
        max_steering_rad=experiment.car.largest_control,
    )
    write_placement(experiment, folder)
    with ExitStack() as opened:
        learned_from = (
            plans_elsewhere(experiment, opened)
            if config.learns_in
            else plans(experiment, opened.enter_context(experiment.open_world()))
        )
        trained = train_policy(
            settings,
            learned_from,
            experiment.expert(experiment.config.paths[0]),
            experiment.view,
            folder,
            _telling(experiment, report),
            number_type,
        )
    report(0.98, "comparing controls on true and learned views")
    summary = {
        "sha256": trained.sha256,
        "naive_sha256": trained.naive_sha256,
        "frames": trained.frames,
        "validation_mae": trained.validation_mae_rad,
        "naive_validation_mae": trained.naive_validation_mae_rad,
        "control_unit": experiment.car.control_unit,
        "on_held_out_views": agreement(experiment, load_policy(trained.path).policy),
    }
    write_json(folder / "policy.json", summary)


def _telling(experiment: Experiment, report: MeasuringReport) -> ImitationProgress:
    """Converts progress of the training to progress of the stage, with the error as a curve for each victim."""
    unit, config = experiment.car.control_unit, experiment.config
    names = {"random": HARDENED, "none": NAIVE}
    names |= {each.textures: name for name, each in config.trained.items() if each.is_of(config.policy)}

    def told(fraction: float, text: str, learned: Learned | None = None) -> None:
        point = None
        if learned is not None:
            victim = names["none" if learned.naive else "random"]
            point = Point(f"Error of the {victim} policy [{unit}]", learned.step, learned.error_rad)
        report(0.98 * fraction, text, point)

    return told


def plans(
    experiment: Experiment,
    scene: World,
    sample: Sample | None = None,
    objects: Sequence[VoxelGridObject] | None = None,
    ending: str = "",
) -> list[SourcePlan]:
    """Frames for each drive from the deployment scene and from the surrogate, with its goal and its teacher.

    Args:
        sample: Draws the colours of all objects ``[K, 3]``; None draws random ones.
        objects: The objects at their places; None uses the world's places.
        ending: Suffix of the sources' names, which distinguishes their frames.
    """
    config = experiment.config.policy
    domains = (
        _face_domains(experiment, scene)
        if has_face(experiment)
        else _object_domains(experiment, scene, objects)
    )
    dressed, any_colours = domains.dressed, domains.any_colours

    def source(domain: str, name: str) -> FrameSource:
        called, drawn = f"{domain}-{name}{ending}", sample or any_colours
        if domain == "surrogate":
            return RenderedSource(called, domains.seen_in_surrogate, experiment.dynamics, drawn)
        if config.own_car:
            speed_mps, dt_s = experiment.car.speed_mps, experiment.config.dt_s
            return SceneSource(called, scene, experiment.view, speed_mps, dt_s, dressed.paint, drawn)
        return RenderedSource(called, seen_in(dressed), experiment.dynamics, drawn)

    found = []
    for name in experiment.config.paths:
        common: dict[str, Any] = {
            "drive_steps": config.drive_steps,
            "goal": experiment.goal(name),
            "expert": experiment.expert(name),
            "driven_m": config.driven_m,
            "drives_from_m": config.drives_from_m,
        }
        amounts = (
            ("deployed", config.deployed_stills, config.deployed_drives),
            ("surrogate", config.surrogate_stills, config.surrogate_drives),
        )
        for domain, stills, drives in amounts:
            found.append(SourcePlan(source(domain, name), stills, drives, **common))
    return found


@dataclass(frozen=True, eq=False)
class _Domains:
    """Sources of frames: the attacked deployment scene, and the surrogate with the objects plain (None) or in any colours."""

    dressed: Dressed
    seen_in_surrogate: Callable[[Array], Show]
    any_colours: Sample


def _object_domains(
    experiment: Experiment, scene: World, objects: Sequence[VoxelGridObject] | None
) -> _Domains:
    """Domains with objects in both scenes, plain or coloured."""
    objects = placed_objects(experiment) if objects is None else objects
    surrogate = surrogate_of(experiment, objects, load_background(experiment))
    light = light_on_panels(experiment)
    lit = None if light is None else DisplayedSensor(surrogate, light)

    def seen(states: Array) -> Show:
        frames = surrogate.prepare(surrogate.camera_poses(torch.from_numpy(np.asarray(states))))

        def show(theta: torch.Tensor | None) -> torch.Tensor:
            painted = surrogate.plain_theta() if theta is None else theta
            return frames.render(painted if lit is None else lit.seen_theta(painted)).images

        return show

    return _Domains(
        stand_in(experiment, scene, objects, native=experiment.config.carrier.training == "native"),
        seen,
        random_textures(experiment, objects, surrogate.theta_shape),
    )


def surrogate_plan(experiment: Experiment) -> SourcePlan:
    """Frames of the learned scene alone, along the first path, to be used with recordings of the real one.

    Raises:
        ConfigError: The experiment attacks no face.
    """
    if not has_face(experiment):
        raise ConfigError(
            f"expected an experiment whose attack is a face (carrier.kind overlay or screen), got {experiment.config.carrier.kind}"
        )
    space, seen = _seen_face(experiment)
    source = RenderedSource("surrogate", seen, experiment.dynamics, _any_face(experiment, space))
    wanted = experiment.config.policy
    return SourcePlan(source, wanted.surrogate_stills, wanted.surrogate_drives, wanted.drive_steps)


def _face_domains(experiment: Experiment, scene: World) -> _Domains:
    """Domains with the learned panel, or with a face on it."""
    space, seen = _seen_face(experiment)
    dressed = PaintedScene(experiment, scene, _TRAINING_TEXTURE_PX)
    return _Domains(dressed, seen, _any_face(experiment, space))


def _any_face(experiment: Experiment, space: FaceSpace) -> Sample:
    return random_textures(experiment, space.surrogate.objects, space.surrogate.theta_shape)


def _seen_face(experiment: Experiment) -> tuple[FaceSpace, Callable[[Array], Show]]:
    """The face in the learned scene, behind the display if a screen shows it, and the policy's view of it."""
    # Plain and attacked views of the same states have the same background.
    background = RememberedBackground(
        load_background(experiment), _KEPT_FRAMES * frame_bytes(experiment.view.pinhole)
    )
    space = face_space(experiment, background, ideal=False)
    surrogate, bare, sensor = space.surrogate, space.plain.seen_by(space.surrogate), space.sensor

    def seen(states: Array) -> Show:
        poses = surrogate.camera_poses(torch.from_numpy(np.asarray(states)))
        plain, attacked = bare.prepare(poses), surrogate.prepare(poses)

        def show(theta: torch.Tensor | None) -> torch.Tensor:
            if theta is None:
                return plain.render(None).images
            behind = sensor.seen_theta(theta) if isinstance(sensor, DisplayedSensor) else theta
            return attacked.render(behind).images

        return show

    return space, seen


def agreement(experiment: Experiment, policy: Policy) -> list[dict[str, float]]:
    """Control of a policy on each held-out view and on the surrogate's image of it, with the first path's goal."""
    views = load_transforms(experiment.stage_folder("capture") / capture.HELD_OUT / "transforms.json")
    surrogate = surrogate_of(experiment, [])
    goal = told(experiment, policy, experiment.config.paths[0])
    goals = torch.tensor([goal], dtype=torch.float32) if goal else None
    rows = []
    for frame in views.frames:
        real = experiment.view.image(load_image(frame)[0])
        with torch.no_grad():
            on_real = float(Remembering.afresh(policy, 1)(images_to_tensor(real), goals)[0])
            rendered = surrogate.render(frame.T_world_from_camera[None], None).images
            on_surrogate = float(Remembering.afresh(policy, 1)(rendered, goals)[0])
        rows.append({"real": on_real, "surrogate": on_surrogate})
    return rows


def write_placement(experiment: Experiment, folder: Path) -> None:
    """Write the objects' places, and each drive's first view without and with them, plain."""
    write_json(folder / "objects.json", describe(experiment))
    background = load_background(experiment)
    bare = surrogate_of(experiment, [], background)
    attacked = [face_object(experiment)] if has_face(experiment) else placed_objects(experiment)
    dressed = surrogate_of(experiment, attacked, background)
    for name, reference in experiment.references.items():
        pose = (planar_pose(*reference.drive_start) @ experiment.mount)[None]
        with_objects = dressed.render(pose, dressed.plain_theta()).images
        write_image(folder / f"{name}_start_view.png", tensor_to_images(bare.render(pose, None).images)[0])
        write_image(folder / f"{name}_start_view_with_objects.png", tensor_to_images(with_objects)[0])
