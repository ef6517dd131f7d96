"""Stage policy: learn to drive from lab and surrogate frames, with the object plain and with random textures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.attack.artifact import face_texture
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.data.dataset import load_image, load_transforms
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.path import Array
from advnerf_core.fields.voxel_grid import inverse_squash
from advnerf_core.files import write_atomically
from advnerf_core.geometry import invert_transform, planar_pose
from advnerf_core.learning.imitation import ImitationConfig, SourcePlan, train_policy
from advnerf_core.learning.sources import Overlay, RenderedSource, SceneSource, Show, Texture
from advnerf_core.policies.pilotnet import images_to_tensor, load_policy
from hardware.worlds.lab.lab import Lab
from nodes.experiment import capture
from nodes.experiment.context import CONTROL_PERIOD_S, Experiment
from nodes.experiment.learned_scene import load_background
from nodes.experiment.objects import attacked_object, last_result_kept, surrogate_of
from nodes.experiment.screen import face_picture, plain_picture, shown
from nodes.runtime.progress import Report

HARDENED, NAIVE = "hardened", "naive"
FILES = {HARDENED: "policy.safetensors", NAIVE: "naive.safetensors"}
_TRAINING_TEXTURE_PX = 128


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Train the victims, then compare their steering on held-out lab views and the surrogate's image of them."""
    config = experiment.config.policy
    settings = ImitationConfig(
        seed=config.seed,
        dagger_rounds=config.dagger_rounds,
        first_steps=config.first_steps,
        round_steps=config.round_steps,
        naive_steps=config.naive_steps,
    )
    expert = Expert(
        experiment.path,
        ExpertConfig(
            speed_mps=experiment.speed_mps,
            stiffness_1pm=config.stiffness_1pm,
            feed_forward=config.feed_forward,
        ),
    )
    with Lab(experiment.lab_config) as lab:
        if experiment.shown_on_monitor:
            lab.set_monitor_image(plain_picture(experiment))
        plans = [
            SourcePlan(
                _lab_source(experiment, lab), config.lab_stills, config.lab_drives, config.drive_steps
            ),
            SourcePlan(
                surrogate_source(experiment),
                config.surrogate_stills,
                config.surrogate_drives,
                config.drive_steps,
            ),
        ]
        trained = train_policy(
            settings, plans, expert, experiment.view, folder, lambda part, text: report(0.98 * part, text)
        )
    report(0.98, "comparing steering on real and learned views")
    summary = {
        "sha256": trained.sha256,
        "naive_sha256": trained.naive_sha256,
        "frames": trained.frames,
        "validation_mae_rad": trained.validation_mae_rad,
        "naive_validation_mae_rad": trained.naive_validation_mae_rad,
        "steering_on_held_out_views": steering_on_held_out_views(experiment),
    }
    write_atomically(folder / "policy.json", json.dumps(summary, indent=1) + "\n")


def victim_file(experiment: Experiment, victim: str) -> Path:
    """Policy file of a victim."""
    return experiment.stage_folder("policy") / FILES[victim]


def steering_on_held_out_views(experiment: Experiment) -> list[dict[str, float]]:
    """Steering [rad] of the hardened victim on each held-out view of the driving camera and on the surrogate's image of it."""
    views = load_transforms(experiment.stage_folder("capture") / capture.HELD_OUT / "transforms.json")
    policy = load_policy(victim_file(experiment, HARDENED)).policy
    surrogate = surrogate_of(experiment, [])
    rows = []
    for frame in views.frames:
        real = experiment.view.image(load_image(frame)[0])
        with torch.no_grad():
            on_real = float(policy(images_to_tensor(real))[0])
            on_surrogate = float(policy(surrogate.render(frame.T_world_from_camera[None], None).images)[0])
        rows.append({"real_rad": on_real, "surrogate_rad": on_surrogate})
    return rows


def _lab_source(experiment: Experiment, lab: Lab) -> SceneSource:
    overlay = _monitor_overlay(experiment, lab) if experiment.shown_on_monitor else _board_overlay(experiment)
    return SceneSource(
        "lab",
        lab,
        experiment.view,
        experiment.speed_mps,
        CONTROL_PERIOD_S,
        overlay,
        experiment.config.object.resolution,
    )


def _monitor_overlay(experiment: Experiment, lab: Lab) -> Overlay:
    """Shows textures on the lab's own monitor and looks again: its optics are not known to any projection."""
    plain = plain_picture(experiment)

    def overlay(rgb: NDArray[np.uint8], state: Array, texture: Texture) -> NDArray[np.uint8]:
        del rgb  # the screen is seen again, not drawn over
        lab.set_monitor_image(
            face_picture(experiment, face_texture(inverse_squash(texture), _TRAINING_TEXTURE_PX))
        )
        x, y, yaw = map(float, state[:3])
        painted, _ = lab.observe_at(x, y, yaw, depth=False)
        lab.set_monitor_image(plain)
        return painted

    return overlay


def _board_overlay(experiment: Experiment) -> Overlay:
    """Paints textures on the board's face with the compositor's own projection."""
    T_camera_from_car = invert_transform(experiment.camera.mount)
    T_world_from_face = experiment.panel.T_world_from_face

    def overlay(rgb: NDArray[np.uint8], state: Array, texture: Texture) -> NDArray[np.uint8]:
        displayed = face_texture(inverse_squash(texture), _TRAINING_TEXTURE_PX)
        face = FaceOverlay(
            displayed, experiment.target.corners, experiment.camera.pinhole, experiment.camera.distortion
        )
        T_camera_from_world = T_camera_from_car @ invert_transform(planar_pose(*state[:3]))
        return face.draw(rgb, T_camera_from_world @ T_world_from_face)[0]

    return overlay


def surrogate_source(experiment: Experiment) -> RenderedSource:
    """Frames of the learned room, with the object plain and with random textures."""
    background = last_result_kept(load_background(experiment))
    bare = surrogate_of(experiment, [], background)
    with_object = surrogate_of(experiment, [attacked_object(experiment)], background)
    sigma = experiment.config.attack.random_sigma
    seen = shown(experiment, with_object).seen_theta if experiment.shown_on_monitor else None

    def prepare(states: Array) -> Show:
        poses = with_object.camera_poses(torch.from_numpy(np.asarray(states)))
        plain, attacked = bare.prepare(poses), with_object.prepare(poses)

        def show(theta: torch.Tensor | None) -> torch.Tensor:
            if theta is None:
                return plain.render(None).images
            return attacked.render(theta if seen is None else seen(theta)).images

        return show

    def sample(rng: np.random.Generator) -> torch.Tensor:
        return torch.from_numpy(sigma * rng.standard_normal(with_object.theta_shape)).float()

    return RenderedSource("surrogate", prepare, experiment.dynamics, sample)
