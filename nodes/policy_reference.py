"""Reference frames for the conformance test: camera images with what the expert would steer there."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.driving.expert import Expert
from advnerf_core.driving.policy_view import PolicyView
from calibration.schema import RoomCalibration, load_calibration
from nodes.pose_buffer import PoseBuffer
from nodes.runtime.bag_images import image_messages, image_topic
from nodes.runtime.bag_read import read_info, read_messages
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import decode, pose_matrix, stamp_ns
from nodes.runtime.pictures import rgb_image
from nodes.runtime.topics import topic as topic_row

_CAR = "/vicon/car"
_LATERAL_M, _HEADING_RAD = 0.15, 0.2


@dataclass(frozen=True, eq=False)
class Reference:
    """Frames of which the right steering is known.

    Attributes:
        images: Policy images ``[N, H, W, 3]`` uint8 RGB.
        steering_rad: The expert's steering ``[N]`` [rad], left positive.
        source: Where they come from, for people.
    """

    images: NDArray[np.uint8]
    steering_rad: NDArray[np.float64]
    source: str


def from_twin(view: PolicyView, count: int = 48, seed: int = 0) -> Reference:
    """Frames of the simulated lab around its path; needs no recording."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from hardware.twin.config import LabConfig
    from hardware.twin.lab import Lab

    expert = Expert(load_calibration(RoomCalibration, _twin_room()).reference_path)
    rng = np.random.default_rng(seed)
    poses = expert.path.pose_at(np.arange(count) / count * expert.path.length_m)
    offsets = rng.uniform(-1.0, 1.0, (count, 2)) * (_LATERAL_M, _HEADING_RAD)
    poses[:, 0] -= np.sin(poses[:, 2]) * offsets[:, 0]
    poses[:, 1] += np.cos(poses[:, 2]) * offsets[:, 0]
    poses[:, 2] += offsets[:, 1]
    with Lab(LabConfig()) as lab:
        frames = [lab.observe_at(x, y, yaw, depth=False)[0] for x, y, yaw in poses.tolist()]
    images = np.stack([_seen(view, frame, "the simulated lab") for frame in frames])
    return Reference(images, np.asarray(expert.steer_states(poses)), f"{count} frames of the simulated lab")


def from_bag(bag: Path, room: Path, view: PolicyView, count: int = 96) -> Reference:
    """Frames of a driven bag, spread over it, labelled by the expert at the recorded poses."""
    poses = PoseBuffer(keep_s=1e6)
    for message in read_messages(bag, [_CAR]):
        pose = decode(topic_row(_CAR).type, message.cdr)
        poses.add(stamp_ns(pose), pose_matrix(pose))
    topic = image_topic(bag)
    recorded = next(row.count for row in read_info(bag).topics if row.name == topic)
    wanted = set(np.linspace(0, recorded - 1, min(count, recorded)).astype(int).tolist())
    expert = Expert(load_calibration(RoomCalibration, room).reference_path)
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
    if len(images) < 4 or np.ptp(steering) == 0.0:
        raise BagError(
            f"expected at least 4 frames with poses and varying steering in {bag}, got {len(images)}; drive further"
        )
    unchecked = ", unchecked" if read_info(bag).unchecked else ""
    return Reference(np.stack(images), np.array(steering), f"{len(images)} frames of {bag}{unchecked}")


def from_run(folder: Path, view: PolicyView, count: int = 180) -> Reference:
    """Plain frames and labels on which the policy of an experiment's run folder was trained."""
    from advnerf_core.driving.frames import FrameStore

    store = FrameStore(folder / "policy" / "frames")
    names = [name for name in store.names() if name.startswith("stills")]
    if not names:
        raise ConfigError(
            f"expected the frames of a policy stage in {store.folder}, found none; give a run folder or a bag"
        )
    frames = store.load(names[0])
    if frames.images.shape[1:3] != (view.height, view.width):
        got = f"{frames.images.shape[2]} x {frames.images.shape[1]}"
        raise ConfigError(
            f"expected frames of {view.width} x {view.height} in {store.folder}, got {got}; use --bag, or no frames"
        )
    plain = np.flatnonzero(~frames.textured)
    chosen = plain[:: max(1, len(plain) // count)]
    steering = np.asarray(frames.steering_rad[chosen], dtype=np.float64)
    return Reference(np.array(frames.images[chosen]), steering, f"{len(chosen)} frames of {folder}")


def _seen(view: PolicyView, rgb: NDArray[np.uint8], source: str) -> NDArray[np.uint8]:
    camera = view.camera
    if rgb.shape[:2] != (camera.height, camera.width):
        raise ConfigError(
            f"expected images of {camera.width} x {camera.height}, for which the policy's view was made, got {rgb.shape[1]} x "
            f"{rgb.shape[0]} from {source}; give frames of the policy's own camera with --bag"
        )
    return view.image(rgb)


def _twin_room() -> Path:
    import calibration

    return Path(calibration.__file__).parent / "twin" / "room.yaml"
