"""Reference frames for the conformance test: camera images with the expert's steering."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.data.image_files import read_stored
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.view_loading import load_image
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.driving.expert import Expert
from advnerf_core.geometry import invert_transform, yaw_of
from advnerf_core.plugins import FAILURES, in_one_line
from advnerf_core.policies.adapter import AdaptedPolicy
from advnerf_core.policies.conformance import FAILURE, OK, WARNING, Finding, Verdict
from advnerf_core.policies.network import images_to_tensor, tensor_to_images
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, RoomCalibration, VehicleCalibration, load_calibration
from nodes.bags.decoded import read_poses
from nodes.bags.images import image_messages, image_topic
from nodes.bags.reader import read_info
from nodes.control.pose_buffer import PoseBuffer
from nodes.lab.policy_camera import require_camera
from nodes.lab.policy_drive import See, drive_round
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import stamp_ns
from nodes.runtime.paths import shipped
from nodes.runtime.pictures import rgb_image

_CAR = "/vicon/car"
_LATERAL_M, _HEADING_RAD = 0.15, 0.2
_FEWEST = 4

Drives = Callable[[Any, tuple[float, ...]], CleanDrive]
"""Drives a policy with a goal where a reference is from, without an attack."""


@dataclass(frozen=True, eq=False)
class ReferenceFrames:
    """Frames with known steering.

    Attributes:
        images: Policy images ``[N, H, W, 3]`` uint8 RGB.
        steering_rad: The expert's steering ``[N]`` [rad], left positive; None if it is not known.
        drives: Drives a policy without an attack in the place of the frames; None if it cannot be driven, as for a bag.
        asked: Whether the user named this place. If so, a policy that does not drive there fails.
    """

    images: NDArray[np.uint8]
    steering_rad: NDArray[np.float64] | None
    source: str
    drives: Drives | None = None
    asked: bool = False


def from_twin(view: PolicyView, count: int = 48) -> ReferenceFrames:
    """Make reference frames in the simulated lab around its path. No recording is needed."""
    from hardware.worlds.lab.config import LabConfig
    from hardware.worlds.lab.lab import Lab

    expert = _expert(shipped("calibration/twin") / "room.yaml")
    poses = _about_the_path(expert, count)

    def frame(lab: Lab, x_m: float, y_m: float, yaw_rad: float) -> NDArray[np.uint8]:
        return _seen(view, lab.observe_at(x_m, y_m, yaw_rad, depth=False)[0], "the simulated lab")

    def drives(policy: Any, goal: tuple[float, ...]) -> CleanDrive:
        with Lab(LabConfig()) as lab:

            def see(states: torch.Tensor) -> torch.Tensor:
                return images_to_tensor(np.stack([frame(lab, *state) for state in states[:, :3].tolist()]))

            return _drives(see, shipped("calibration/twin"))(policy, goal)

    with Lab(LabConfig()) as lab:
        images = np.stack([frame(lab, *pose) for pose in poses.tolist()])
    source = f"{count} frames of the simulated lab"
    return ReferenceFrames(images, np.asarray(expert.steer_states(poses)), source, drives)


def from_bag(bag: Path, room: Path, view: PolicyView, count: int = 96) -> ReferenceFrames:
    """Take reference frames spread over a bag, labelled by the expert at the recorded poses."""
    poses = PoseBuffer.of_recording(read_poses(bag, _CAR))
    topic = image_topic(bag)
    recorded = next(row.count for row in read_info(bag).topics if row.name == topic)
    wanted = set(np.linspace(0, recorded - 1, min(count, recorded)).astype(int).tolist())
    expert = _expert(room)
    images, steering = [], []
    for number, image in enumerate(image_messages(bag, topic)):
        if number not in wanted:
            continue
        found = poses.at(stamp_ns(image), 0.0)
        if found is None:
            continue
        T = found.T
        images.append(_seen(view, rgb_image(image, f"{topic} in {bag}"), str(bag)))
        steering.append(float(expert.steer(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))))
    if len(images) < _FEWEST or np.ptp(steering) == 0.0:
        raise BagError(
            f"expected at least {_FEWEST} frames with poses and varying steering in {bag}, got {len(images)}; record a longer drive"
        )
    unchecked = ", unchecked" if read_info(bag).unchecked else ""
    return ReferenceFrames(
        np.stack(images), np.array(steering), f"{len(images)} frames of {bag}{unchecked}", asked=True
    )


def from_picture(file: Path, view: PolicyView) -> ReferenceFrames:
    """A picture of the policy's camera, its mirror image, and both at half the brightness; the right steering is unknown."""
    rgb, _ = read_stored(file)
    both = np.stack([_seen(view, each, str(file)) for each in (rgb, np.ascontiguousarray(rgb[:, ::-1]))])
    return ReferenceFrames(np.concatenate([both, both // 2]), None, f"{file}, mirrored and darker")


def from_run(folder: Path, view: PolicyView) -> ReferenceFrames:
    """Take the camera frames of an experiment's capture, and drives in its learned scene.

    The frames are full camera images, which the policy's view crops and resizes.
    """
    capture = folder / "capture"
    calibration = capture / "calibration"
    if not (capture / "held_out" / "transforms.json").is_file() or not (calibration / "room.yaml").is_file():
        raise ConfigError(
            f"expected the run folder of an experiment in a room, with capture/held_out and capture/calibration, got {folder}; "
            "give another folder, a bag (--bag) or a scene (--scene)"
        )
    camera = _camera(view, calibration)
    expert = _expert(calibration / "room.yaml")
    images, steering = [], []
    for name in ("held_out", "colour_pairs"):
        if not (capture / name / "transforms.json").is_file():
            continue
        for frame in load_transforms(capture / name / "transforms.json").frames:
            car = frame.T_world_from_camera @ invert_transform(camera.mount)
            images.append(_seen(view, load_image(frame)[0], str(folder)))
            steering.append(float(expert.steer(car[0, 3], car[1, 3], yaw_of(car))))
    if len(images) < _FEWEST or np.ptp(steering) == 0.0:
        raise ConfigError(
            f"expected at least {_FEWEST} frames of varying steering in {capture}, got {len(images)}"
        )
    scene = folder / "scene" / "scene.safetensors"
    drives = _drives_in_scene(scene, calibration, view) if scene.is_file() else None
    return ReferenceFrames(
        np.stack(images), np.array(steering), f"{len(images)} camera frames of {folder}", drives, True
    )


def from_scene(scene: Path, calibration: Path, view: PolicyView, count: int = 48) -> ReferenceFrames:
    """Render reference frames of a learned scene around the path of a room, and drives in it.

    Args:
        calibration: Folder with ``camera.yaml``, ``room.yaml`` and ``vehicle.yaml``.
    """
    _camera(view, calibration)
    expert = _expert(calibration / "room.yaml")
    poses = _about_the_path(expert, count)
    seen = _sight_of_scene(scene, calibration, view)(torch.from_numpy(poses))
    images = tensor_to_images(seen)
    drives = _drives_in_scene(scene, calibration, view)
    return ReferenceFrames(
        images, np.asarray(expert.steer_states(poses)), f"{count} frames of {scene}", drives, True
    )


def _drives_in_scene(scene: Path, calibration: Path, view: PolicyView) -> Drives:
    return _drives(_sight_of_scene(scene, calibration, view), calibration)


def _sight_of_scene(scene: Path, calibration: Path, view: PolicyView) -> See:
    """Renderer of the policy's images of a learned scene, with the intrinsics of its view, including the crop."""
    from advnerf_core.scene.surrogate import Surrogate
    from advnerf_core.splats.scene_file import load_renderer

    mount = load_calibration(CameraCalibration, calibration / "camera.yaml").mount
    surrogate = Surrogate(load_renderer(scene), view.pinhole, mount, [])
    nothing = torch.zeros(surrogate.theta_shape)
    return lambda states: surrogate.sense(states, nothing).images


def _drives(see: See, calibration: Path) -> Drives:
    room = load_calibration(RoomCalibration, calibration / "room.yaml")
    vehicle = load_calibration(VehicleCalibration, calibration / "vehicle.yaml")
    return lambda policy, goal: drive_round(policy, see, room, vehicle, goal)


def _camera(view: PolicyView, calibration: Path) -> CameraCalibration:
    camera = load_calibration(CameraCalibration, calibration / "camera.yaml")
    require_camera(view, camera.pinhole, "", calibration / "camera.yaml")
    return camera


def _expert(room: Path) -> Expert:
    return Expert(load_calibration(RoomCalibration, room).reference_path)


def _about_the_path(expert: Expert, count: int) -> NDArray[np.float64]:
    """Car states ``[count, 3]`` around the path, with small offsets and rotations from it."""
    offsets = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 2)) * (_LATERAL_M, _HEADING_RAD)
    poses: NDArray[np.float64] = expert.path.pose_at(np.arange(count) / count * expert.path.length_m)
    poses[:, 0] -= np.sin(poses[:, 2]) * offsets[:, 0]
    poses[:, 1] += np.cos(poses[:, 2]) * offsets[:, 0]
    poses[:, 2] += offsets[:, 1]
    return poses


def judged_by_drives(
    policy: AdaptedPolicy,
    reference: ReferenceFrames,
    findings: list[Finding],
    goal: tuple[float, ...] | None = None,
) -> list[Finding]:
    """Add the finding of test drives to the findings on a policy's adapter. The adapter must be right before it is driven.

    A policy that does not drive in the place that the user named fails. For a place that cannot be driven, such as a bag, the
    comparison with the expert decides.
    """
    if any(finding.verdict == FAILURE for finding in findings):
        return findings
    if reference.drives is None:
        return [
            replace(f, verdict=FAILURE) if f.name == "expert" and f.verdict == WARNING else f
            for f in findings
        ]
    size = policy.contract.goal_size
    try:
        clean = reference.drives(policy, goal if goal is not None else (0.0,) * size)
    except FAILURES as error:  # of the policy, which may raise anything
        return [*findings, Finding("drive", FAILURE, f"the drive without attack fails: {in_one_line(error)}")]
    text = clean.warning or f"drives without attack: {clean.in_words.removeprefix('drive without attack: ')}"
    verdict: Verdict = OK if clean.drives else FAILURE if reference.asked else WARNING
    return [*findings, Finding("drive", verdict, text)]


def _seen(view: PolicyView, rgb: NDArray[np.uint8], source: str) -> NDArray[np.uint8]:
    camera = view.camera
    if rgb.shape[:2] != (camera.height, camera.width):
        raise ConfigError(
            f"expected images of {camera.width} x {camera.height}, as in the policy's view, got {rgb.shape[1]} x "
            f"{rgb.shape[0]} from {source}; give frames of the policy's camera with --bag, or one with --picture"
        )
    return view.image(rgb)
