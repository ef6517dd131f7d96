"""Makes data sets from images and recordings: a ``transforms.json`` and a report, whose content each import returns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.image_files import read_stored
from advnerf_core.data.lens import Lens
from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.files import write_json
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.scene.auto_box import CAMERA_MARGIN
from calibration.phone_and_car import Placed, place_in_mocap
from calibration.photo_model import Model, PhotoSource, SfmConfig
from calibration.scans.scan import Picture
from calibration.structure_from_motion import reconstruct
from calibration.world_axes import extent_scale
from nodes.lab.importing.driven_bag import CAR_CAMERA, BagConfig, DrivenFrames, take_frames
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import IMAGES, MediaConfig, gather
from nodes.lab.importing.metric import OwnScale, place, undistorted_views
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.staging import (
    COLMAP,
    MASKS,
    REPORT_FILE,
    TRANSFORMS,
    TRANSFORMS_CAR,
    TRANSFORMS_PHONE,
    build_beside,
)
from nodes.runtime.progress import Report

_MEDIA_SHARE = 0.3
_BOX_PERCENT, _BOX_MARGIN = 0.5, 0.05
# Without points the walls may be anywhere: beyond the cameras the scene is contracted. Any aabb_scale above 1 says so.
_UNBOUNDED = 16


Facts = dict[str, Any]
# Cars of a motion-capture world drive at z = 0, see advnerf_core.geometry.planar_pose.
_MOCAP: Facts = {"scale": "metric: motion capture", "ground_at_zero": True}


def from_media(
    media: Sequence[Path],
    output: Path,
    media_config: MediaConfig,
    sfm: SfmConfig,
    extent_m: float,
    metric: MetricOptions,
    report: Report,
) -> Facts:
    """Make an upright data set from videos and photographs.

    Args:
        media: Videos and folders of photographs.
        output: Folder of the data set. A stopped run resumes there.
        extent_m: Assumed largest distance between two camera positions [m]; not used if ``metric`` gives the scale.
    """

    def build(folder: Path) -> Facts:
        sources = gather(
            media, folder, media_config, lambda share, text="": report(_MEDIA_SHARE * share, text)
        )
        model = _reconstruct(folder, sources, sfm, report)
        assumed = OwnScale(
            extent_scale(model, extent_m), None, f"not metric: an extent of {extent_m:g} m was assumed"
        )
        similarity, placing = place(model, {}, lambda: undistorted_views(model, folder), metric, assumed)
        poses, points = similarity.poses(model.poses), similarity.points(model.points)
        facts = {"structure_from_motion": model.summary(), **placing}
        return write_model_set(folder, model, poses, points, facts)

    return build_beside(output, [*media, metric.positions], build)


def from_bag(
    bag: Path,
    output: Path,
    config: BagConfig,
    margin_m: float,
    report: Report,
    calibration: Path | None = None,
) -> Facts:
    """Make a data set from recorded frames with motion-capture poses. No pose is estimated.

    Args:
        margin_m: Margin of the scene box around the camera's trajectory [m].
        calibration: Camera calibration file; None uses the one in the bag.
    """

    def build(folder: Path) -> Facts:
        frames = take_frames(bag, folder / IMAGES / CAR_CAMERA, config, report, calibration)
        positions = frames.T_world_from_camera[:, :3, 3]
        facts = {"bag": str(bag), **_bag_facts(frames), **_MOCAP}
        reach = np.concatenate([positions - margin_m, positions + margin_m])
        _write_car(folder / TRANSFORMS, frames, {**_box(reach, margin=0.0), "world": "mocap"})
        return _reported(folder, facts)

    return build_beside(output, [bag, calibration], build, resumes=False)


def from_phone_and_car(
    media: Sequence[Path],
    bag: Path,
    output: Path,
    media_config: MediaConfig,
    bag_config: BagConfig,
    sfm: SfmConfig,
    tolerance_m: float,
    report: Report,
    calibration: Path | None = None,
) -> Facts:
    """Combine phone media and frames of a bag in one model, metric and in the motion-capture world.

    ``transforms.json`` has all registered images with the model's poses, ``transforms_phone.json`` only the phone's (for
    training), ``transforms_car.json`` all frames of the car with their motion-capture poses (to fit colours and to compare).
    """

    def build(folder: Path) -> Facts:
        frames = take_frames(
            bag,
            folder / IMAGES / CAR_CAMERA,
            bag_config,
            lambda share, text="": report(0.1 * share, text),
            calibration,
        )
        sources = gather(
            media,
            folder,
            media_config,
            lambda share, text="": report(0.1 + (_MEDIA_SHARE - 0.1) * share, text),
        )
        if any(source.camera_id == CAR_CAMERA for source in sources):
            raise ImportRecordingError(
                f"expected phone media with another name than {CAR_CAMERA!r}, which is the driving camera's; rename it"
            )
        names = tuple(file.relative_to(folder).as_posix() for file in frames.files)
        camera = frames.calibration
        car = PhotoSource(
            CAR_CAMERA, names, ordered=True, pinhole=camera.pinhole, lens=Lens(camera.distortion)
        )
        model = _reconstruct(folder, [*sources, car], sfm, report)
        placed = place_in_mocap(model, dict(zip(names, frames.T_world_from_camera, strict=True)), tolerance_m)
        facts = {
            "bag": str(bag),
            **_bag_facts(frames),
            "structure_from_motion": model.summary(),
            "placing": placed.summary(),
            **_MOCAP,
        }
        return _write_joint(folder, model, placed, frames, facts)

    return build_beside(output, [*media, bag, calibration], build)


def _reconstruct(output: Path, sources: Sequence[PhotoSource], sfm: SfmConfig, report: Report) -> Model:
    return reconstruct(
        output,
        sources,
        output / COLMAP,
        sfm,
        lambda share, text: report(_MEDIA_SHARE + (1.0 - _MEDIA_SHARE) * share, text),
    )


def write_model_set(
    output: Path,
    model: Model,
    poses: Array,
    points: Array,
    facts: Facts,
    pictures: Sequence[Picture] = (),
    reached: Array | None = None,
) -> Facts:
    """Write ``transforms.json`` for images that are in a folder, and the report.

    Args:
        output: Folder that the names of the images are relative to.
        poses: ``T_world_from_camera [N, 4, 4]`` of the images.
        points: Points of the scene ``[M, 3]``.
        pictures: Masks and splits of the images; empty for none.
        reached: Points ``[M, 3]`` around the content, for a scene without points.
    """
    box = _box_of(points, poses) if len(points) else _open_box(poses, reached)
    if not len(points) and read_stored(output / model.images[0].name)[1] is not None:
        box = {}  # training finds that of the silhouettes
    masks = [output / MASKS / f"{each.name}.png" if each.mask else None for each in pictures]
    extra = {**box, **_splits(pictures)}
    _write_model(output / TRANSFORMS, output, model, poses, range(len(model.images)), extra, masks)
    return _reported(output, facts)


def _write_joint(output: Path, model: Model, placed: Placed, frames: DrivenFrames, facts: Facts) -> Facts:
    poses, everything = placed.T_world_from_camera, range(len(model.images))
    extra = {**_box_of(placed.points, poses), "world": "mocap"}
    phone = [index for index in everything if model.images[index].camera_id != CAR_CAMERA]
    if not phone:
        raise ImportRecordingError(
            "expected images of the phone in one model with the car's, got none; also film along the track at the car's height"
        )
    _write_model(output / TRANSFORMS, output, model, poses, everything, extra)
    _write_model(output / TRANSFORMS_PHONE, output, model, poses, phone, extra)
    _write_car(output / TRANSFORMS_CAR, frames, extra)
    return _reported(output, facts)


def _write_model(
    path: Path,
    output: Path,
    model: Model,
    poses: Array,
    chosen: Sequence[int],
    extra: dict[str, Any],
    masks: Sequence[Path | None] = (),
) -> None:
    images = [model.images[index] for index in chosen]
    write_transforms(
        path,
        [output.absolute() / image.name for image in images],
        poses[list(chosen)],
        [image.pinhole for image in images],
        lens=[image.lens for image in images],
        camera_ids=[image.camera_id for image in images],
        masks=masks or None,
        extra=extra,
    )


def _splits(pictures: Sequence[Picture]) -> dict[str, list[str]]:
    """nerfstudio's lists of files by split."""
    splits: dict[str, list[str]] = {}
    for each in pictures:
        if each.split is not None:
            splits.setdefault(f"{each.split}_filenames", []).append(f"{IMAGES}/{each.name}")
    return splits


def _write_car(path: Path, frames: DrivenFrames, extra: dict[str, Any]) -> None:
    camera, count = frames.calibration, len(frames.files)
    pinhole: Pinhole = camera.pinhole
    write_transforms(
        path,
        [file.absolute() for file in frames.files],
        frames.T_world_from_camera,
        pinhole,
        lens=Lens(camera.distortion),
        camera_ids=[CAR_CAMERA] * count,
        extra=extra,
    )


def _bag_facts(frames: DrivenFrames) -> Facts:
    return {
        "recorded_frames": frames.recorded,
        "without_pose": frames.without_pose,
        "taken_frames": len(frames.files),
        "unchecked": frames.unchecked,
    }


def _box_of(points: Array, poses: Array) -> dict[str, Any]:
    """Box around nearly all points and all cameras. A few points of every model lie far outside."""
    ends = (
        np.percentile(points, [_BOX_PERCENT, 100.0 - _BOX_PERCENT], axis=0)
        if len(points)
        else np.zeros((0, 3))
    )
    return _box(np.concatenate([ends, poses[:, :3, 3]]), _BOX_MARGIN)


def _open_box(poses: Array, reached: Array | None) -> dict[str, Any]:
    """Inner box of an unbounded scene around the cameras and what they reach, as far as that is known."""
    places = poses[:, :3, 3]
    known = places if reached is None or not len(reached) else np.concatenate([places, reached])
    return {**_box(known, CAMERA_MARGIN), "aabb_scale": _UNBOUNDED}


def _box(corners: Array, margin: float) -> dict[str, Any]:
    """Scene cube in the format of Instant-NGP, whose unit cube is ``scale x + offset``."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = 1.0 / (float((high - low).max()) * (1.0 + 2.0 * margin))
    return {"aabb_scale": 1, "scale": scale, "offset": (0.5 - scale * 0.5 * (low + high)).tolist()}


def _reported(output: Path, facts: Facts) -> Facts:
    write_json(output / REPORT_FILE, facts)
    return facts
