"""Real and learned pictures of the simulated lab, without and with an attack: what the fidelity gate and the prediction of transfer look at.

Real pictures with an attack are made from real pictures without: from a driven bag without attack, into which the face is drawn by the
code that draws it live. On the monitor the face is drawn in the colours that its calibration says the camera sees.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.artifact import AttackFile, face_texture
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.data.dataset import load_transforms
from advnerf_core.driving.metrics import Horizon
from advnerf_core.geometry import Array, invert_transform, planar_poses, yaw_of
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.scene.fidelity import Pictures
from nodes.bags.reader import read_messages
from nodes.control.pose_buffer import PoseBuffer
from nodes.experiment import attack, capture
from nodes.experiment.cells import CellFault, attack_file, drive_without_attack_of, is_searched
from nodes.experiment.context import CONTROL_PERIOD_S, Experiment
from nodes.experiment.images import as_uint8
from nodes.experiment.learned_scene import load_background
from nodes.experiment.objects import attacked_object, surrogate_of
from nodes.experiment.policy import victim_file
from nodes.experiment.screen import shown
from nodes.runtime.errors import BagError
from nodes.runtime.messages import decode, ns_from_stamp, pose_matrix
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import topic as topic_row

Rgb = NDArray[np.uint8]
_MOST_FRAMES = 120
_CAR, _IMAGE, _SAFETY = "/vicon/car", "/compositor/image", "/safety/state"


def policy_of(experiment: Experiment, victim: str, scenario: str) -> tuple[Any, tuple[float, ...]]:
    """The victim and what it is told; in the room nothing."""
    del scenario
    return load_policy(victim_file(experiment, victim)).policy, ()


def held_out(experiment: Experiment, scenario: str) -> Pictures:
    """The driving camera's views that nothing was learned from."""
    del scenario
    views = load_transforms(experiment.stage_folder("capture") / capture.HELD_OUT, require_all=True).load()
    real = np.stack([experiment.view.image(rgb) for rgb in views.rgb])
    return Pictures(
        "held-out views",
        real,
        _learned(surrogate_of(experiment, []), np.stack(list(views.T_world_from_camera)), None),
    )


def driven(
    experiment: Experiment, scenario: str, victim: str, seed: int, folder: Path, bag: Path | None = None
) -> Pictures:
    """What the camera saw on a live drive without attack.

    Args:
        experiment: The experiment.
        scenario: Not used; there is one drive.
        victim: Whose drive without attack.
        seed: Which of its drives.
        folder: A cell's folder, beside which drives without attack are kept.
        bag: Instead, a bag of any drive without attack.
    """
    del scenario
    frames, states = _posed_frames(bag or drive_without_attack_of(experiment, victim, seed, folder))
    learned = _learned(surrogate_of(experiment, []), planar_poses(states) @ experiment.camera.mount, None)
    return Pictures("driven bag", np.stack([experiment.view.image(rgb) for rgb in frames]), learned)


def lacks(experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path) -> str:
    """What a prediction still needs, in words; empty if all is there."""
    del scenario
    if not is_searched(experiment, victim, method, seed, folder):
        return "its search"
    try:
        drive_without_attack_of(experiment, victim, seed, folder)
    except CellFault:
        return "the live drive without attack: run the cell of method none first"
    return ""


def attacked(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path
) -> Pictures:
    """The same drive, frame by frame, with the face of a finished search drawn in; nothing here was deployed with it."""
    del scenario
    found = attack_file(experiment, victim, method, seed, folder)
    frames, states = _posed_frames(drive_without_attack_of(experiment, victim, seed, folder))
    cars = planar_poses(states)
    overlay = _overlay(experiment, found)
    T_world_from_subject = experiment.panel.T_world_from_face
    real = []
    for rgb, car in zip(frames, cars, strict=True):
        drawn, _ = overlay.draw(rgb, invert_transform(car @ experiment.camera.mount) @ T_world_from_subject)
        real.append(experiment.view.image(drawn))
    sensor = attack.sensor_of(experiment, surrogate_of(experiment, [attacked_object(experiment)]))
    theta = torch.from_numpy(np.array(found.face_object.theta))
    return Pictures(
        "driven bag, attacked", np.stack(real), _learned(sensor, cars @ experiment.camera.mount, theta)
    )


def loop(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path
) -> tuple[AttackProblem, Callable[[torch.Tensor, bool], torch.Tensor], torch.Tensor, Horizon]:
    """What a prediction drives: the problem, pictures with or without the attack, the deployed starts ``[S, n]`` and the horizon."""
    del scenario
    theta = torch.from_numpy(
        np.array(attack_file(experiment, victim, method, seed, folder).face_object.theta)
    )
    background = load_background(experiment)
    bare = surrogate_of(experiment, [], background)
    sensor = attack.sensor_of(experiment, surrogate_of(experiment, [attacked_object(experiment)], background))
    problem = attack.attack_problem(experiment, sensor, load_policy(victim_file(experiment, victim)), seed)

    def images(states: torch.Tensor, with_attack: bool) -> torch.Tensor:
        return sensor.sense(states, theta).images if with_attack else bare.sense(states, None).images

    starts = torch.tensor([experiment.room.start_pose], dtype=problem.start_states.dtype)
    return (
        problem,
        images,
        starts,
        Horizon(experiment.config.horizon, CONTROL_PERIOD_S, experiment.room.off_track_m),
    )


def _overlay(experiment: Experiment, found: AttackFile) -> FaceOverlay:
    texture = found.required_face().texture
    if experiment.shown_on_monitor:
        sensor = shown(experiment, surrogate_of(experiment, [attacked_object(experiment)]))
        texture = face_texture(sensor.seen_theta(torch.from_numpy(np.array(found.face_object.theta))).numpy())
    return FaceOverlay(
        texture, experiment.target.corners, experiment.camera.pinhole, experiment.camera.distortion
    )


def _learned(sensor: Any, poses: Array, theta: torch.Tensor | None) -> Rgb:
    return np.stack([as_uint8(sensor.render(pose[None], theta).images[0]) for pose in poses])


def _posed_frames(bag: Path) -> tuple[list[Rgb], Array]:
    """Frames that were captured while the car was armed, of a long drive an even choice, and the car's states ``[N, 3]`` at their stamps."""
    poses, armed = PoseBuffer(keep_s=1e6), []
    for message in read_messages(bag, [_CAR, _SAFETY]):
        decoded = decode(topic_row(message.topic).type, message.cdr)
        stamp_ns = ns_from_stamp(decoded.header.stamp)
        if message.topic == _CAR:
            poses.add(stamp_ns, pose_matrix(decoded))
        elif decoded.armed:
            armed.append(stamp_ns)
    frames, states = [], []
    for message in read_messages(bag, [_IMAGE]):
        image = decode(topic_row(_IMAGE).type, message.cdr)
        stamp_ns = ns_from_stamp(image.header.stamp)
        pose = poses.at(stamp_ns, 0.0)
        if pose is not None and armed and min(armed) <= stamp_ns <= max(armed):
            frames.append(rgb_image(image, f"{_IMAGE} in {bag}").copy())
            states.append((pose.T[0, 3], pose.T[1, 3], yaw_of(pose.T)))
    if not frames:
        raise BagError(
            f"expected images on {_IMAGE} with poses on {_CAR} while the car was armed in {bag}, got none"
        )
    step = -(-len(frames) // _MOST_FRAMES)  # neighbouring frames of a long drive say no more
    return frames[::step], np.array(states)[::step]
