"""Stage policy: one goal-conditioned network learns all drives, from the deployment scene and the surrogate, by DAgger."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.data.dataset import load_image, load_transforms
from advnerf_core.data.image_files import write_image
from advnerf_core.driving.path import Array
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.files import write_atomically
from advnerf_core.geometry import planar_pose
from advnerf_core.learning.imitation import ImitationConfig, SourcePlan, train_policy
from advnerf_core.learning.sources import RenderedSource, Show
from advnerf_core.policies.pilotnet import images_to_tensor, load_policy
from hardware.worlds.world import World
from nodes.experiment.images import as_uint8
from nodes.experiment.junction import capture
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.objects import describe, placed_objects, random_theta, surrogate_of
from nodes.experiment.learned_scene import load_background
from nodes.runtime.progress import Report

HARDENED, NAIVE, RETRAINED = "hardened", "naive", "retrained"
VICTIMS = (HARDENED, NAIVE)
FILES = {HARDENED: "policy.safetensors", NAIVE: "naive.safetensors"}
# Poses that the policy learns from: as far from the path [m, of half a lane of 1.75 m], and as turned [rad], as a recovery may have to begin.
_STILLS, _DRIVES, _GIVE_UP_M = (1.6, 0.3), (0.8, 0.12), 3.0

Sample = Callable[[np.random.Generator], torch.Tensor]


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Train the victims, then compare their controls on held-out views and on the surrogate's image of them."""
    config = experiment.config.policy
    settings = ImitationConfig(
        seed=config.seed,
        dagger_rounds=config.dagger_rounds,
        first_steps=config.first_steps,
        round_steps=config.round_steps,
        naive_steps=config.naive_steps,
        hidden=config.hidden,
        lateral_m=experiment.across_m(_STILLS[0]),
        heading_rad=_STILLS[1],
        drive_lateral_m=experiment.across_m(_DRIVES[0]),
        drive_heading_rad=_DRIVES[1],
        give_up_m=experiment.across_m(_GIVE_UP_M),
        max_steering_rad=experiment.car.largest_control,
    )
    write_placement(experiment, folder)
    with experiment.open_world() as scene:
        trained = train_policy(
            settings,
            plans(experiment, scene),
            experiment.expert(experiment.config.scenarios[0]),
            experiment.view,
            folder,
            lambda part, text: report(0.98 * part, text),
        )
    report(0.98, "comparing controls on true and learned views")
    summary = {
        "sha256": trained.sha256,
        "naive_sha256": trained.naive_sha256,
        "frames": trained.frames,
        "validation_mae": trained.validation_mae_rad,
        "naive_validation_mae": trained.naive_validation_mae_rad,
        "control_unit": experiment.car.control_unit,
        "on_held_out_views": agreement(experiment),
    }
    write_atomically(folder / "policy.json", json.dumps(summary, indent=1) + "\n")


def victims(experiment: Experiment) -> tuple[str, ...]:
    """The policies that are attacked."""
    return VICTIMS if experiment.config.policy.naive_steps else (HARDENED,)


def attackable(experiment: Experiment) -> tuple[str, ...]:
    """The policies that there are to attack: also the retrained one, where the experiment retrains."""
    return (*victims(experiment), *([] if experiment.config.retrain is None else [RETRAINED]))


def victim_file(experiment: Experiment, victim: str) -> Path:
    """Policy file of a victim; the retrained one is that of the first round, as in the paper."""
    if victim == RETRAINED:
        return experiment.stage_folder("retrain") / "round0" / "policy.safetensors"
    return experiment.stage_folder("policy") / FILES[victim]


def plans(
    experiment: Experiment,
    scene: World,
    sample: Sample | None = None,
    objects: Sequence[VoxelGridObject] | None = None,
    ending: str = "",
) -> list[SourcePlan]:
    """For each drive its frames from the deployment scene and from the surrogate, with its goal and its teacher.

    Args:
        experiment: The experiment.
        scene: The deployment scene.
        sample: Draws the colours of all objects ``[K, 3]``; None draws random ones.
        objects: The objects where they are to stand; None has them where the world does.
        ending: Of the sources' names, which tell their frames apart.
    """
    config, background = experiment.config.policy, load_background(experiment)
    objects = placed_objects(experiment) if objects is None else objects
    dressed = DressedScene(scene, experiment.view, objects)
    surrogate = surrogate_of(experiment, objects, background)
    sigma, shape = experiment.config.attack.random_sigma, surrogate.theta_shape

    def any_colours(rng: np.random.Generator) -> torch.Tensor:
        return random_theta(shape, sigma, rng)

    def seen_in_surrogate(states: Array) -> Show:
        frames = surrogate.prepare(surrogate.camera_poses(torch.from_numpy(np.asarray(states))))
        return lambda theta: frames.render(surrogate.plain_theta() if theta is None else theta).images

    def seen_in_scene(states: Array) -> Show:
        frames = dressed.prepare(states)
        return lambda theta: images_to_tensor(dressed.policy_images(frames, theta))

    found = []
    for name in experiment.config.scenarios:
        common: dict[str, Any] = {
            "drive_steps": config.drive_steps,
            "goal": experiment.goal(name),
            "expert": experiment.expert(name),
            "driven_m": config.driven_m,
            "drives_from_m": config.drives_from_m,
        }
        domains = (
            ("deployed", seen_in_scene, config.deployed_stills, config.deployed_drives),
            ("surrogate", seen_in_surrogate, config.surrogate_stills, config.surrogate_drives),
        )
        for domain, prepare, stills, drives in domains:
            source = RenderedSource(
                f"{domain}-{name}{ending}", prepare, experiment.dynamics, sample or any_colours
            )
            found.append(SourcePlan(source, stills, drives, **common))
    return found


def agreement(experiment: Experiment) -> list[dict[str, float]]:
    """Control of the hardened victim on each held-out view and on the surrogate's image of it, told to follow the first path."""
    views = load_transforms(experiment.stage_folder("capture") / capture.HELD_OUT / "transforms.json")
    policy = load_policy(victim_file(experiment, HARDENED)).policy
    surrogate = surrogate_of(experiment, [])
    goal = torch.tensor([experiment.goal(experiment.config.scenarios[0])])
    rows = []
    for frame in views.frames:
        real = experiment.view.image(load_image(frame)[0])
        with torch.no_grad():
            on_real = float(policy(images_to_tensor(real), goal)[0])
            on_surrogate = float(
                policy(surrogate.render(frame.T_world_from_camera[None], None).images, goal)[0]
            )
        rows.append({"real": on_real, "surrogate": on_surrogate})
    return rows


def write_placement(experiment: Experiment, folder: Path) -> None:
    """The objects' places, and each drive's first view without and with them, plain."""
    write_atomically(folder / "objects.json", json.dumps(describe(experiment), indent=1) + "\n")
    background = load_background(experiment)
    bare = surrogate_of(experiment, [], background)
    dressed = surrogate_of(experiment, placed_objects(experiment), background)
    for name, reference in experiment.references.items():
        pose = (planar_pose(*reference.start_pose) @ experiment.mount)[None]
        with_objects = dressed.render(pose, dressed.plain_theta()).images[0]
        write_image(folder / f"{name}_start_view.png", as_uint8(bare.render(pose, None).images[0]))
        write_image(folder / f"{name}_start_view_with_objects.png", as_uint8(with_objects))
