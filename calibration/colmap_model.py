"""Structure from motion with COLMAP, in a separate process; see `calibration.structure_from_motion`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array
from calibration import colmap_database as database
from calibration.lens_choice import FOCAL_RATIOS, LensChoice, choose_lenses, intrinsics
from calibration.only_turned import turned
from calibration.photo_model import (
    MIN_IMAGES,
    FoundCamera,
    LeftOut,
    Model,
    PhotoSource,
    ReconstructionError,
    Registered,
    Report,
    SfmConfig,
)
from calibration.zoomed import own_focal_lengths, require_one_focal_length

# Shares of the wall time, roughly: features, matches, poses, lenses.
_FEATURES_UNTIL, _MATCHES_UNTIL, _POSES_UNTIL = 0.25, 0.65, 0.93
_FINISHED = "finished.json"
_SHOWN_NAMES = 5


def put_together(
    root: Path, sources: Sequence[PhotoSource], work: Path, config: SfmConfig, report: Report
) -> Model:
    """Reconstruct a model from photographs; see `calibration.structure_from_motion.reconstruct`."""
    names = [name for source in sources for name in source.images]
    file = database.open_work(root, work, sources, asdict(config))
    cameras = database.camera_names(file, sources)
    model = _read_finished(work, sources, cameras)
    if model is None:
        model = _find_model(file, root, work, sources, cameras, config, report)
    _require_enough(model, names, config)
    return model


def _find_model(
    file: Path,
    root: Path,
    work: Path,
    sources: Sequence[PhotoSource],
    cameras: Mapping[int, str],
    config: SfmConfig,
    report: Report,
) -> Model:
    names = [name for source in sources for name in source.images]
    database.extract_features(
        file, root, names, config.max_features, config.peak_threshold, _part(report, 0.0, _FEATURES_UNTIL)
    )
    pairs = database.pairs_to_match(file, sources, config)
    database.match(file, work, pairs, config.seed, _part(report, _FEATURES_UNTIL, _MATCHES_UNTIL))
    _require_moved(file)
    held = database.held_cameras(file, sources)
    best, parts = _map(
        file, root, work, held, len(names), config, _part(report, _MATCHES_UNTIL, _POSES_UNTIL)
    )
    placed = {image.name for image in best.images.values() if image.has_pose}
    choices, why = choose_lenses(
        best, held, database.exif_focal_lengths(file), _part(report, _POSES_UNTIL, 1.0)
    )
    own = own_focal_lengths(best, held)
    require_one_focal_length({cameras[number]: images for number, images in own.items()})
    elsewhere = "it could not be placed: too little overlap with the others, or blur"
    why |= {name: elsewhere for name in names if name not in placed}
    _write_finished(work, best, parts, choices, why)
    return _model(best, sources, cameras, parts, choices, why)


def _require_moved(file: Path) -> None:
    """Refuse photographs of a camera that only turned: noise would be taken for parallax, and poses, lens and scale be invented."""
    found = turned(database.verified_matches(file))
    if found.only:
        raise ReconstructionError(
            f"expected photographs from different places, got ones of a camera that only turned: rotation alone explains the matches of {found.share:.0%} "
            f"of {found.pairs} pairs of them; move the camera between photographs, by a tenth of the distance to what it sees or more"
        )


def _part(report: Report, low: float, high: float) -> Report:
    return lambda share, text: report(low + (high - low) * share, text)


def _map(
    file: Path, root: Path, work: Path, held: set[int], total: int, config: SfmConfig, report: Report
) -> tuple[Any, int]:
    """Return the largest of COLMAP's models, and the number of models."""
    import pycolmap

    sparse, placed = work / "sparse", 0
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = config.seed, False
    options.num_threads = 1  # sums over threads in another order end in another model
    options.constant_cameras = held
    options.min_focal_length_ratio, options.max_focal_length_ratio = FOCAL_RATIOS
    # Indoors walls are smooth: COLMAP's own limits, made for buildings outdoors, would leave many a photograph out.
    options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 60, 15

    def one_more() -> None:
        nonlocal placed
        placed = min(placed + 1, total)  # images of an abandoned part are counted again
        report(placed / total, f"{placed} of {total} images placed")

    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir()
    pycolmap.set_random_seed(config.seed)
    with database.quiet():
        found = pycolmap.incremental_mapping(file, root, sparse, options, next_image_callback=one_more)
    if not found:
        raise ReconstructionError(
            f"expected {total} photographs of one scene, but no two could be matched; take photographs with overlap (every spot in three "
            "photographs) and texture, and move the camera between them instead of only turning it"
        )
    best = max(found, key=lambda number: (found[number].num_reg_images(), found[number].num_points3D()))
    return found[best], len(found)


def _write_finished(
    work: Path, reconstruction: Any, parts: int, choices: Mapping[int, LensChoice], why: Mapping[str, str]
) -> None:
    folder = work / "sparse" / "chosen"
    folder.mkdir()
    reconstruction.write(folder)
    record = {
        "parts": parts,
        "choices": {number: asdict(choice) for number, choice in choices.items()},
        "why": dict(why),
    }
    write_atomically(work / _FINISHED, json.dumps(record, indent=1))


def _read_finished(work: Path, sources: Sequence[PhotoSource], cameras: Mapping[int, str]) -> Model | None:
    import pycolmap

    if not (work / _FINISHED).exists():
        return None
    record = read_json(work / _FINISHED)
    choices = {int(number): LensChoice(**choice) for number, choice in record["choices"].items()}
    reconstruction = pycolmap.Reconstruction(work / "sparse" / "chosen")
    return _model(reconstruction, sources, cameras, record["parts"], choices, record["why"])


def _model(
    reconstruction: Any,
    sources: Sequence[PhotoSource],
    camera_ids: Mapping[int, str],
    parts: int,
    choices: Mapping[int, LensChoice],
    why: Mapping[str, str],
) -> Model:
    names = [name for source in sources for name in source.images]
    by_name = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    registered = []
    for name in (name for name in names if name in by_name):
        image = by_name[name]
        T = np.eye(4)
        T[:3] = image.cam_from_world().inverse().matrix()
        pinhole, lens = intrinsics(image.camera)
        registered.append(Registered(name, camera_ids[image.camera_id], T, pinhole, lens))
    points = [
        p.xyz
        for _, p in sorted(reconstruction.points3D.items(), key=lambda item: item[0])
        if p.track.length() >= 3
    ]
    cameras = []
    for number in dict.fromkeys(by_name[image.name].camera_id for image in registered):
        choice, images = choices[number], sum(image.camera_id == camera_ids[number] for image in registered)
        found = intrinsics(reconstruction.cameras[number])
        cameras.append(
            FoundCamera(
                camera_ids[number], images, choice.model, choice.why, *found, choice.focal_error_percent
            )
        )
    left_out = tuple(LeftOut(name, why[name]) for name in names if name not in by_name)
    error_px = float(reconstruction.compute_mean_reprojection_error())
    return Model(tuple(registered), left_out, _array(points), error_px, parts, tuple(cameras))


def _array(points: Sequence[NDArray[np.float64]]) -> Array:
    return np.array(points, np.float64).reshape(-1, 3)


def _require_enough(model: Model, names: Sequence[str], config: SfmConfig) -> None:
    needed = max(MIN_IMAGES, int(np.ceil(config.min_registered_share * len(names))))
    if len(model.images) >= needed:
        if not len(model.points):
            raise ReconstructionError(
                f"expected points that several of the {len(model.images)} images see from different places, got none: their poses are invented; "
                "move the camera between photographs instead of only turning it"
            )
        return
    shown = "; ".join(f"{image.name}: {image.why}" for image in model.left_out[:_SHOWN_NAMES])
    more = "; ..." if len(model.left_out) > _SHOWN_NAMES else ""
    raise ReconstructionError(
        f"expected at least {needed} of {len(names)} images in one model, got {len(model.images)} ({model.parts} separate parts; not in "
        f"it: {shown}{more}); take more photographs between the parts, from places that see both, with less blur"
    )
