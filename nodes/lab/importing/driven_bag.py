"""Takes frames of a bag with the camera's pose at each capture stamp, from motion capture and calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.image_files import Rgb, write_image
from advnerf_core.data.similarity import rotation_angles
from advnerf_core.data.video import thinned
from advnerf_core.geometry import Array
from calibration.schema import CameraCalibration, load_calibration, parse_calibration
from nodes.bags.decoded import read_poses
from nodes.bags.images import image_messages, image_topic
from nodes.bags.one_clock import require_one_clock
from nodes.bags.reader import read_attachment, read_info
from nodes.control.pose_buffer import PoseBuffer
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.wizards.bags import require_metres_and_z_up
from nodes.runtime.errors import BagError
from nodes.runtime.messages import stamp_ns
from nodes.runtime.pictures import rgb_image
from nodes.runtime.progress import Report

CAR_TOPIC = "/vicon/car"
CAR_CAMERA = "car"
_ATTACHED_CALIBRATION = "camera.yaml"


@dataclass(frozen=True)
class BagConfig:
    """Selection of frames of a bag.

    Attributes:
        step_m: Distance between two frames [m].
        step_rad: Rotation after which the next frame is taken even without that distance [rad].
        most: Largest number of frames, evenly thinned out.
    """

    step_m: float = 0.1
    step_rad: float = 0.087
    most: int = 300


@dataclass(frozen=True, eq=False)
class DrivenFrames:
    """Frames on disk with their poses.

    Attributes:
        files: Image files in order of time, named by their capture stamps [ns since 1970].
        T_world_from_camera: ``[N, 4, 4]`` in the motion-capture world.
        recorded: Number of frames in the bag.
        without_pose: Number of frames that were skipped because motion capture had a gap.
        unchecked: Why damage to the bag may go unnoticed; empty if checksums cover it.
    """

    files: tuple[Path, ...]
    T_world_from_camera: Array
    calibration: CameraCalibration
    recorded: int
    without_pose: int
    unchecked: str = ""


def take_frames(
    bag: Path, folder: Path, config: BagConfig, report: Report, calibration: Path | None = None
) -> DrivenFrames:
    """Write frames of a bag as PNG files and determine their poses.

    Args:
        folder: Folder for the files, which are named by their capture stamps.
        calibration: Camera calibration file; None uses the one attached to the bag.

    Raises:
        BagError: The bag is unfinished or lacks the topics.
        ImportRecordingError: The calibration is missing, the image size differs from it, or the frames have no poses.
    """
    camera = _camera(bag, calibration)
    rows = list(read_poses(bag, CAR_TOPIC))
    if rows:
        require_metres_and_z_up(np.stack([T for _, T in rows]), bag, CAR_TOPIC)
    poses = PoseBuffer.of_recording(rows)
    topic = image_topic(bag)
    require_one_clock(bag, (topic, CAR_TOPIC))
    stamps = [stamp_ns(message) for message in image_messages(bag, topic)]
    placed = [
        (index, stamp, pose.T @ camera.mount)
        for index, stamp in enumerate(stamps)
        if (pose := poses.at(stamp))
    ]
    if not placed:
        raise ImportRecordingError(
            f"expected frames of {bag} with poses of {CAR_TOPIC} at their stamps, got {len(stamps)} frames without any pose; "
            "was the motion capture on, and were both clocks synchronised?"
        )
    chosen = choose_by_motion(np.stack([T for _, _, T in placed]), config)
    if len(chosen) < 2:
        raise ImportRecordingError(
            f"expected frames of {bag} from several places, got {len(placed)} within {config.step_m:g} m of one: the car stood; drive it through the place"
        )
    wanted = {placed[i][0]: placed[i] for i in chosen}
    files = _write_frames(bag, topic, folder, wanted, camera, report)
    return DrivenFrames(
        tuple(files),
        np.stack([wanted[index][2] for index in sorted(wanted)]),
        camera,
        len(stamps),
        len(stamps) - len(placed),
        read_info(bag).unchecked,
    )


def choose_by_motion(T_world_from_camera: Array, config: BagConfig) -> list[int]:
    """Indices of poses ``[N, 4, 4]`` that are at least a step from the previous one in position or angle; at most ``config.most``."""
    chosen = [0]
    for index, pose in enumerate(T_world_from_camera):
        last = T_world_from_camera[chosen[-1]]
        moved = float(np.linalg.norm(pose[:3, 3] - last[:3, 3]))
        turned = float(rotation_angles(last[:3, :3].T @ pose[:3, :3]))
        if moved >= config.step_m or turned >= config.step_rad:
            chosen.append(index)
    return thinned(chosen, config.most)


def _camera(bag: Path, file: Path | None) -> CameraCalibration:
    if file is not None:
        return load_calibration(CameraCalibration, file)
    try:
        content = read_attachment(bag, _ATTACHED_CALIBRATION)
    except BagError as error:
        raise ImportRecordingError(
            f"expected the camera's calibration: {error}; give its file with --calibration"
        ) from error
    return parse_calibration(CameraCalibration, content, f"{_ATTACHED_CALIBRATION} in {bag}")


def _write_frames(
    bag: Path,
    topic: str,
    folder: Path,
    wanted: dict[int, tuple[int, int, Array]],
    camera: CameraCalibration,
    report: Report,
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    total = next((t.count for t in read_info(bag).topics if t.name == topic), 0)
    files = []
    for index, message in enumerate(image_messages(bag, topic)):
        report(index / max(total, 1), f"frame {index + 1} of {total}")
        if index not in wanted:
            continue
        file = folder / f"{wanted[index][1]}.png"
        if not file.exists():  # an existing file is complete, because it was written under another name first
            write_image(file, _rgb(message, camera, f"{topic} in {bag}"))
        files.append(file)
    for stranger in set(folder.glob("*.png")) - set(files):
        stranger.unlink()
    return files


def _rgb(message: Any, camera: CameraCalibration, source: str) -> Rgb:
    image = rgb_image(message, source)
    if image.shape[:2] != (camera.height, camera.width):
        raise ImportRecordingError(
            f"expected frames of {camera.width} x {camera.height}, as calibrated, got {image.shape[1]} x {image.shape[0]} on {source}; "
            "give the calibration of this camera with --calibration"
        )
    return image
