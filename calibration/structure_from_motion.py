"""Poses, intrinsics and points of photographs of one scene by structure from motion (COLMAP, by its Python package).

Any number of cameras, each with its own intrinsics: unknown ones are found (``OPENCV`` model), known ones can be held. Work is kept
in a folder and goes on where it was stopped. Everything runs on the CPU.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.scene.lens import Lens
from calibration import colmap_database as database

Report = Callable[[float, str], None]
# Shares of the wall time, roughly: features, matches, poses.
_FEATURES_UNTIL, _MATCHES_UNTIL = 0.25, 0.65
_MIN_IMAGES = 3
_SHOWN_NAMES = 5


class ReconstructionError(AdvnerfError):
    """Photographs could not be put together; the message says how far it went and what to do."""


@dataclass(frozen=True)
class Source:
    """Photographs of one camera.

    Attributes:
        camera_id: Name of the camera.
        images: Files, relative to the folder of all images.
        ordered: Whether they follow each other in time, so that neighbours overlap.
        pinhole: Intrinsics where they are known; they are then held.
        lens: Distortion where it is known.
    """

    camera_id: str
    images: tuple[str, ...]
    ordered: bool = False
    pinhole: Pinhole | None = None
    lens: Lens = field(default_factory=Lens)

    def __post_init__(self) -> None:
        if not self.images:
            raise ReconstructionError(f"expected images of camera {self.camera_id!r}, got none")
        if self.lens.fisheye:
            raise ReconstructionError(
                f"expected camera {self.camera_id!r} with the OPENCV model, got a fisheye; undistort its images first"
            )


@dataclass(frozen=True)
class SfmConfig:
    """How photographs are put together.

    Attributes:
        max_features: Most local features of an image.
        peak_threshold: Contrast below which a spot is no feature; lower finds more in smooth rooms.
        all_pairs_up_to: Up to so many images every pair is matched; beyond, neighbours and those that look alike.
        overlap: Followers of an image in its video that it is matched with.
        look_alikes: Images that look like it that each is matched with.
        min_registered_share: With fewer images registered than this share the result is refused.
        seed: Of all randomness.
    """

    max_features: int = 4096
    peak_threshold: float = 0.002
    all_pairs_up_to: int = 100
    overlap: int = 10
    look_alikes: int = 30
    min_registered_share: float = 0.5
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Registered:
    """One image that has a pose.

    Attributes:
        name: File, relative to the folder of all images.
        camera_id: Its camera.
        T_world_from_camera: Pose ``[4, 4]`` in the model's own world and scale, OpenCV axes.
        pinhole: Intrinsics.
        lens: Distortion.
        observations: Number of points of the model that it sees.
    """

    name: str
    camera_id: str
    T_world_from_camera: Array
    pinhole: Pinhole
    lens: Lens
    observations: int


@dataclass(frozen=True, eq=False)
class Model:
    """What structure from motion found.

    Attributes:
        images: Images with poses, in the order they were given.
        unregistered: Images without.
        points: Points of the scene ``[M, 3]``, seen from three images or more.
        reprojection_error_px: Mean distance of a point's projection from where it was seen [px].
        parts: How many separate models there were; this is the largest.
    """

    images: tuple[Registered, ...]
    unregistered: tuple[str, ...]
    points: Array
    reprojection_error_px: float
    parts: int

    @property
    def poses(self) -> Array:
        """``T_world_from_camera`` ``[N, 4, 4]``."""
        return np.stack([image.T_world_from_camera for image in self.images])

    def summary(self) -> dict[str, Any]:
        """What a report says."""
        cameras = {
            image.camera_id: {
                "fl_x": image.pinhole.fx, "fl_y": image.pinhole.fy, "cx": image.pinhole.cx, "cy": image.pinhole.cy,
                "distortion": list(image.lens.coefficients),
                "registered": sum(other.camera_id == image.camera_id for other in self.images),
            }
            for image in self.images
        }  # fmt: skip
        return {
            "registered": len(self.images), "unregistered": list(self.unregistered), "points": len(self.points),
            "reprojection_error_px": self.reprojection_error_px, "parts": self.parts, "cameras": cameras,
        }  # fmt: skip


def reconstruct(
    root: Path, sources: Sequence[Source], work: Path, config: SfmConfig | None = None, report: Report | None = None
) -> Model:
    """Put photographs together.

    Args:
        root: Folder of all images.
        sources: The cameras and their images.
        work: Folder for what is kept between runs; with other images or another configuration it is begun anew.
        config: Numbers.
        report: Told of the finished share and what is being done.

    Raises:
        ReconstructionError: An unreadable image, too few images, or too few that could be put together.
    """
    config, report = config or SfmConfig(), report or (lambda fraction, text: None)
    names = [name for source in sources for name in source.images]
    if len(names) < _MIN_IMAGES or len(set(names)) != len(names):
        raise ReconstructionError(
            f"expected at least {_MIN_IMAGES} different images, got {len(names)} ({len(set(names))} different); take more photographs"
        )
    file = database.open_work(root, work, sources, asdict(config))
    database.extract_features(
        file,
        root,
        names,
        config.max_features,
        config.peak_threshold,
        lambda done, text: report(_FEATURES_UNTIL * done, text),
    )
    pairs = database.pairs_to_match(file, sources, config)
    database.match(
        file, work, pairs,
        lambda done, text: report(_FEATURES_UNTIL + (_MATCHES_UNTIL - _FEATURES_UNTIL) * done, text),
    )  # fmt: skip
    best, parts = _map(file, root, work, sources, config, report)
    model = _model(best, sources, parts)
    _require_enough(model, names, config)
    return model


def _map(
    file: Path, root: Path, work: Path, sources: Sequence[Source], config: SfmConfig, report: Report
) -> tuple[Any, int]:
    import pycolmap

    sparse, finished = work / "sparse", work / "finished.json"
    if finished.exists():
        record = json.loads(finished.read_text())
        return pycolmap.Reconstruction(sparse / record["model"]), int(record["parts"])
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = config.seed, False
    options.num_threads = 1  # sums over threads in another order end in another model
    options.constant_cameras = database.held_cameras(file, sources)
    # Indoors walls are smooth: COLMAP's own limits, made for buildings outdoors, would leave many a photograph out.
    options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 60, 15
    total, placed = sum(len(source.images) for source in sources), 0

    def one_more() -> None:
        nonlocal placed
        placed = min(placed + 1, total)  # images of a part that is given up are counted again
        report(_MATCHES_UNTIL + (0.99 - _MATCHES_UNTIL) * placed / total, f"{placed} of {total} images placed")

    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir()
    pycolmap.set_random_seed(config.seed)
    with database.quiet():
        found = pycolmap.incremental_mapping(file, root, sparse, options, next_image_callback=one_more)
    if not found:
        raise ReconstructionError(
            f"expected {total} photographs of one scene, could not put any two together; they need overlap (every spot in three "
            "photographs), texture, and movement of the camera between them, not only turning"
        )
    best = max(found, key=lambda number: (found[number].num_reg_images(), found[number].num_points3D()))
    folder = sparse / str(best)
    folder.mkdir(exist_ok=True)
    found[best].write(folder)
    write_atomically(finished, json.dumps({"model": folder.name, "parts": len(found)}))
    return found[best], len(found)


def _model(reconstruction: Any, sources: Sequence[Source], parts: int) -> Model:
    camera_of = {name: source.camera_id for source in sources for name in source.images}
    by_name = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    registered = []
    for name, camera_id in camera_of.items():
        if name not in by_name:
            continue
        image = by_name[name]
        T = np.eye(4)
        T[:3] = image.cam_from_world().inverse().matrix()
        pinhole, lens = database.intrinsics(image.camera)
        registered.append(Registered(name, camera_id, T, pinhole, lens, image.num_points3D))
    points = [
        p.xyz for _, p in sorted(reconstruction.points3D.items(), key=lambda item: item[0]) if p.track.length() >= 3
    ]
    unregistered = tuple(name for name in camera_of if name not in by_name)
    return Model(
        tuple(registered), unregistered, _array(points), float(reconstruction.compute_mean_reprojection_error()), parts
    )


def _array(points: Sequence[NDArray[np.float64]]) -> Array:
    return np.array(points, np.float64).reshape(-1, 3)


def _require_enough(model: Model, names: Sequence[str], config: SfmConfig) -> None:
    needed = max(_MIN_IMAGES, int(np.ceil(config.min_registered_share * len(names))))
    if len(model.images) >= needed:
        return
    shown = ", ".join(model.unregistered[:_SHOWN_NAMES]) + (", ..." if len(model.unregistered) > _SHOWN_NAMES else "")
    raise ReconstructionError(
        f"expected at least {needed} of {len(names)} images in one model, got {len(model.images)} ({model.parts} separate parts; not in "
        f"it: {shown}); take more photographs between the parts, from places that see both, with less blur"
    )
