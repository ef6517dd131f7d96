"""Real and learned pictures, without and with an attack, for the fidelity gate and the prediction of transfer.

Real pictures come from the deployment scene, with the opaque objects composed by depth, from the car's poses on its drive past the plain
objects; for a live drive from its bag, into which a face is drawn by the same code as live, on a screen in the colours that its
calibration predicts for the camera. No drive with the attack is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.artifact import AttackFile, face_texture
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.attack.spaces.space import Shown, Space
from advnerf_core.attack.transfer import AttackableScene
from advnerf_core.documents import read_json
from advnerf_core.driving.measured_car import CarResponse, RespondingCar, fit_response
from advnerf_core.driving.metrics import Horizon
from advnerf_core.geometry import Array, invert_transform, planar_poses, yaw_of
from advnerf_core.policies.network import tensor_to_images
from advnerf_core.scene.fidelity import PicturePairs
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.world import Rgb
from nodes.bags.decoded import read_decoded, read_poses
from nodes.control.pose_buffer import PoseBuffer
from nodes.experiment.engine.run_folder import ATTACK
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.drives import deployed_drives
from nodes.experiment.show.faces import face_space, has_face, on_screen, panel_of
from nodes.experiment.show.learned_scene import HELD_OUT, captured
from nodes.experiment.show.objects import surrogate_of
from nodes.experiment.show.spaces import dress, make_space, shown_there
from nodes.experiment.show.victims import load_victim, told
from nodes.experiment.steps.attack import Prepared, from_measured_starts, load_found
from nodes.experiment.steps.deploy import DRIVES, live_name
from nodes.runtime.errors import BagError, RuntimeFault
from nodes.runtime.messages import stamp_ns
from nodes.runtime.pictures import rgb_image

_MOST_FRAMES = 120
_CAR, _IMAGE, _SAFETY = "/vicon/car", "/compositor/image", "/safety/state"


def policy_of(experiment: Experiment, cell: Cell) -> tuple[Any, tuple[float, ...]]:
    """The victim and its goal on the cell's path, or on the first path."""
    policy = load_victim(experiment, cell.victim).policy
    return policy, told(experiment, policy, cell.scenario or experiment.config.paths[0])


def held_out(experiment: Experiment) -> PicturePairs:
    """Held-out views of the driving camera, around all drives, without objects."""
    views = captured(experiment, HELD_OUT).load()
    surrogate = surrogate_of(experiment, [])
    learned = _learned(surrogate, views.T_world_from_camera, None)
    return PicturePairs(
        "held-out views", np.stack([experiment.view.image(rgb) for rgb in views.rgb]), learned
    )


def driven(experiment: Experiment, cell: Cell, clean: Path, bag: Path | None = None) -> PicturePairs:
    """Images of the camera on the deployed drive without an attack.

    Args:
        clean: Folder of the cell's live drives without attack.
        bag: Instead, a bag of any live drive without attack.

    Raises:
        RuntimeFault: A bag is given but drives come from the scene, or there is no live drive yet.
    """
    if bag is None and not experiment.config.deploy.live:
        return _along_the_drive(experiment, cell, None, "drive without attack")
    if bag is not None and not has_face(experiment):
        raise RuntimeFault(
            "expected no bag for drives that are asked of the scene (deploy.through world); leave --bag out"
        )
    frames, states = posed_frames(bag or clean_bag(cell, clean))
    surrogate = surrogate_of(experiment, [])
    learned = _learned(surrogate, planar_poses(states) @ experiment.mount, None)
    return PicturePairs("driven bag", np.stack([experiment.view.image(rgb) for rgb in frames]), learned)


def lacks(experiment: Experiment, cell: Cell, folder: Path, clean: Path) -> str:
    """Missing inputs of a prediction, as text; empty if complete."""
    if not (folder / ATTACK).exists():
        return "its search"
    if experiment.config.deploy.live:
        try:
            clean_bag(cell, clean)
        except RuntimeFault:
            return "the live drive without attack: run the cell of method none first"
    elif experiment.config.deploy.car == "own" and not (clean / DRIVES).exists():
        return "the deployed drives without attack, which show the car: run the cell of method none first (--only method=none)"
    return ""


def attacked(experiment: Experiment, cell: Cell, folder: Path, clean: Path) -> PicturePairs:
    """The same places with the colours of a finished search."""
    space, attack = _found(experiment, cell, folder)
    shown = space.restored(attack)
    if not experiment.config.deploy.live:
        there = shown_there(experiment, shown, attack)
        return _along_the_drive(experiment, cell, (shown, there), "the same drive, attacked")
    frames, states = posed_frames(clean_bag(cell, clean))
    cars, overlay, panel = planar_poses(states), _overlay(experiment, attack), panel_of(experiment)
    real = []
    for rgb, car in zip(frames, cars, strict=True):
        drawn, _ = overlay.draw(rgb, invert_transform(car @ experiment.mount) @ panel.T_world_from_face)
        real.append(experiment.view.image(drawn))
    surrogate = shown.seen_by(space.surrogate)
    learned = _learned(surrogate, cars @ experiment.mount, shown.colours)
    return PicturePairs("driven bag, attacked", np.stack(real), learned)


def loop(
    experiment: Experiment, cell: Cell, folder: Path, clean: Path
) -> tuple[AttackProblem, RespondingCar, AttackableScene, torch.Tensor, Horizon]:
    """Inputs of a prediction: the problem, the car, pictures with or without the attack, the deployed starts ``[S, n]`` and the horizon.

    The car has the response of the deployed drives without attack in the folder ``clean``.
    """
    space, attack = _found(experiment, cell, folder)
    found, plain = space.restored(attack), space.plain
    with_it, without = (each.seen_by(space.surrogate) for each in (found, plain))
    problem = from_measured_starts(experiment, cell.scenario, Prepared.of(experiment, space, cell).problem)
    car = _measured_car(experiment, clean)

    def images(states: torch.Tensor, attacked: bool) -> torch.Tensor:
        sensor, colours = (with_it, found.colours) if attacked else (without, plain.colours)
        return sensor.sense(states[:, :3], colours).images

    starts = experiment.measured_starts(cell.scenario)[: experiment.config.deploy.starts]
    return problem, car, images, car.start(starts), experiment.limits


def _measured_car(experiment: Experiment, clean: Path) -> RespondingCar:
    """The deployed car with the response of its drives without attack; the search's own car if that one drives, or if they were live."""
    ideal, kept = experiment.dynamics, clean / DRIVES
    # Commands of live drives are in their bags, each with a delay of its own.
    if experiment.config.deploy.car == "ideal" or experiment.config.deploy.live or not kept.exists():
        return RespondingCar(ideal, CarResponse(ideal.speed_mps))
    return RespondingCar(ideal, fit_response(*_until_blocked(read_json(kept)), ideal))


def _until_blocked(kept: Mapping[str, Any]) -> tuple[list[Array], list[Array]]:
    """Poses ``[T + 1, 3]`` and commands ``[T]`` of each kept drive, until it stood against something."""
    ends = [
        tick or len(commands) for tick, commands in zip(kept["blocked_tick"], kept["commands"], strict=True)
    ]
    poses = [np.array(each)[: end + 1] for each, end in zip(kept["states"], ends, strict=True)]
    controls = [np.array(each)[:end] for each, end in zip(kept["commands"], ends, strict=True)]
    return poses, controls


def _found(experiment: Experiment, cell: Cell, folder: Path) -> tuple[Space, AttackFile]:
    """The space, in the learned scene, and the attack file of a finished search."""
    attack = load_found(folder, cell)
    assert attack is not None, "a prediction is of a method"
    return make_space(experiment, None), attack


def clean_bag(cell: Cell, clean: Path) -> Path:
    """The bag of the live drive that cells of this victim and seed are compared with.

    Raises:
        RuntimeFault: The drive does not exist yet, or its bag is gone.
    """
    bag = clean / live_name(0) / "bag"
    if not bag.exists():
        raise RuntimeFault(
            f"expected the live drive without attack of the {cell.victim} victim, seed {cell.seed}, at {bag}, got none; run that cell first"
        )
    return bag


def _overlay(experiment: Experiment, attack: AttackFile) -> FaceOverlay:
    """Draws the face into pictures of the driving camera, in the colours for the camera."""
    face, texture = attack.required_face(), attack.required_face().texture
    if on_screen(experiment):
        sensor = face_space(experiment, ideal=False).sensor
        assert isinstance(sensor, DisplayedSensor), "a screen is not taken for ideal here"
        texture = face_texture(
            sensor.seen_theta(torch.from_numpy(np.array(attack.face_object.theta))).numpy()
        )
    return FaceOverlay(texture, face.corners_in_subject, experiment.camera)


def _learned(sensor: Surrogate, poses: Array, theta: torch.Tensor | None) -> Rgb:
    return np.concatenate([tensor_to_images(sensor.render(pose[None], theta).images) for pose in poses])


def _along_the_drive(
    experiment: Experiment,
    cell: Cell,
    attack: tuple[Shown, torch.Tensor | None] | None,
    of: str,
) -> PicturePairs:
    """Pictures of the deployed drive without attack, again with an attack if one is given: in the surrogate, and in the deployment."""
    space = make_space(experiment, None)
    policy, _ = policy_of(experiment, cell)
    shown, there = attack or (space.plain, shown_there(experiment, space.plain, None))
    with experiment.open_deployed_world() as scene:
        dressed = dress(experiment, scene, space.plain)
        start = experiment.measured_starts(cell.scenario)[:1]
        plain = shown_there(experiment, space.plain, None)
        (drive,) = deployed_drives(experiment, dressed, policy, cell.scenario, start, plain)
        states = drive.states[:-1]
        real = dressed.policy_images(dressed.prepare(states), there)
    surrogate = shown.seen_by(space.surrogate)
    poses = planar_poses(states) @ experiment.mount
    return PicturePairs(of, real, _learned(surrogate, poses, shown.colours))


def posed_frames(bag: Path) -> tuple[list[Rgb], Array]:
    """Frames that were captured while the car was armed, evenly thinned out for a long drive, and the car's states ``[N, 3]`` at their stamps."""
    poses = PoseBuffer.of_recording(read_poses(bag, _CAR))
    armed = [stamp_ns(state) for state in read_decoded(bag, _SAFETY) if state.armed]
    frames, states = [], []
    for image in read_decoded(bag, _IMAGE):
        stamp = stamp_ns(image)
        pose = poses.at(stamp, 0.0)
        if pose is not None and armed and min(armed) <= stamp <= max(armed):
            frames.append(rgb_image(image, f"{_IMAGE} in {bag}").copy())
            states.append((pose.T[0, 3], pose.T[1, 3], yaw_of(pose.T)))
    if not frames:
        raise BagError(
            f"expected images on {_IMAGE} with poses on {_CAR} while the car was armed in {bag}, got none"
        )
    step = -(-len(frames) // _MOST_FRAMES)  # neighbouring frames of a long drive add nothing
    return frames[::step], np.array(states)[::step]
