"""COLMAP's database of cameras, features and matches, from which a stopped run resumes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from advnerf_core.data.image_files import image_size
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array
from calibration.lens_choice import FIRST_MODEL, FOCAL_RATIOS
from calibration.photo_model import PhotoSource, Report, SfmConfig
from calibration.photo_pairs import chosen_pairs, every_pair

_FILE, _KEY = "database.db", "inputs.json"
_MOST_TRIALS = 2000
# Pairs are matched in calls of about this length, so that progress moves; each call builds its index of features again.
_CALL_S, _FIRST_PAIRS, _MOST_PAIRS = 2.0, 8, 400
_FEWEST_MATCHES = 30  # of a pair whose geometry says something
# Raised when cameras or features are made in another way: earlier work is then repeated.
_VERSION = 2
# Where the focal length is unknown: a phone's main camera and most others lie within a factor of two of this many image widths.
_GUESSED_FOCAL_LENGTH = 0.9


def threads() -> int:
    """Number of threads that this process may use."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Limit COLMAP's log to errors, because it writes several lines for each image."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def open_work(root: Path, work: Path, sources: Sequence[PhotoSource], config: Mapping[str, Any]) -> Path:
    """Open the database of a stopped run with the same inputs, or create a new one with all cameras and images."""
    key = _key(root, sources, config)
    file = work / _FILE
    if file.exists() and (work / _KEY).exists() and (work / _KEY).read_text() == key:
        return file
    if work.exists():
        shutil.rmtree(work)
    work.mkdir(parents=True)
    _create(file, root, sources)
    write_atomically(work / _KEY, key)
    return file


def _key(root: Path, sources: Sequence[PhotoSource], config: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for source in sources:
        digest.update(repr((source.camera_id, source.ordered, source.pinhole, source.lens)).encode())
        for name in source.images:
            digest.update(name.encode() + b"\0" + hashlib.sha256((root / name).read_bytes()).digest())
    return json.dumps(
        {"version": _VERSION, "config": dict(config), "images": digest.hexdigest()}, sort_keys=True
    )


def _create(file: Path, root: Path, sources: Sequence[PhotoSource]) -> None:
    """One camera for each name, image size, and camera and focal length of the EXIF data; a phone held upright is another camera."""
    import pycolmap

    pycolmap.Database.open(file).close()
    groups: dict[tuple[object, ...], tuple[PhotoSource, tuple[int, int], float | None, list[str]]] = {}
    for source in sources:
        for name in source.images:
            size, (model, focal_px) = image_size(root / name), exif(root / name)
            key = (source.camera_id, source.pinhole, source.lens, size, model, focal_px)
            groups.setdefault(key, (source, size, focal_px, []))[3].append(name)
    for source, size, focal_px, names in groups.values():
        options = pycolmap.ImageReaderOptions()
        options.default_focal_length_factor = _GUESSED_FOCAL_LENGTH
        options.camera_model = FIRST_MODEL if source.pinhole is None else "OPENCV"
        if (params := _params(source, size, focal_px)) is not None:
            options.camera_params = ",".join(f"{value:.17g}" for value in params)
        with quiet():
            pycolmap.import_images(file, root, pycolmap.CameraMode.SINGLE, names, options)


def exif(path: Path) -> tuple[str | None, float | None]:
    """Camera and focal length [px] in the EXIF data of a photograph; None if missing."""
    import pycolmap

    with path.open("rb") as stream:
        if b"Exif\0" not in stream.read(1 << 16):
            return None, None
    with quiet():
        bitmap = pycolmap.Bitmap.read(path, True)
    if bitmap is None:
        return None, None
    focal_px = bitmap.exif_focal_length()
    return bitmap.exif_camera_model(), float(focal_px) if focal_px else None


def _params(source: PhotoSource, size: tuple[int, int], focal_px: float | None) -> list[float] | None:
    width, height = size
    if source.pinhole is not None:
        p = source.pinhole.resized(width, height)
        return [p.fx, p.fy, p.cx, p.cy, *source.lens.coefficients[:4]]
    if focal_px is None or not FOCAL_RATIOS[0] <= focal_px / max(size) <= FOCAL_RATIOS[1]:
        return None
    return [focal_px, 0.5 * width, 0.5 * height, 0.0]


def exif_focal_lengths(file: Path) -> dict[int, float]:
    """Focal lengths from EXIF data [px], by COLMAP's number of the camera."""
    import pycolmap

    with pycolmap.Database.open(file) as database:
        cameras = database.read_all_cameras()
    return {int(c.camera_id): float(c.focal_length_x) for c in cameras if c.has_prior_focal_length}


def held_cameras(file: Path, sources: Sequence[PhotoSource]) -> set[int]:
    """COLMAP's numbers of the cameras whose intrinsics are known."""
    import pycolmap

    known = {name for source in sources if source.pinhole is not None for name in source.images}
    with pycolmap.Database.open(file) as database:
        return {image.camera_id for image in database.read_all_images() if image.name in known}


def camera_names(file: Path, sources: Sequence[PhotoSource]) -> dict[int, str]:
    """Names of COLMAP's cameras: the source's, with the image or the image size where a source has several cameras."""
    import pycolmap

    source_of = {name: source.camera_id for source in sources for name in source.images}
    with pycolmap.Database.open(file) as database:
        cameras = {int(camera.camera_id): camera for camera in database.read_all_cameras()}
        images: dict[int, list[str]] = {number: [] for number in sorted(cameras)}
        for image in database.read_all_images():
            images[int(image.camera_id)].append(image.name)
    of_source: dict[str, list[int]] = {}
    for number, names in images.items():
        of_source.setdefault(source_of[names[0]], []).append(number)
    found: dict[int, str] = {}
    for source, numbers in of_source.items():
        for number in numbers:
            camera, names = cameras[number], images[number]
            what = PurePosixPath(names[0]).stem if len(names) == 1 else f"{camera.width}x{camera.height}"
            name = source if len(numbers) == 1 else f"{source}/{what}"
            found[number] = name if name not in found.values() else f"{name} (camera {number})"
    return found


def extract_features(
    file: Path, root: Path, names: Sequence[str], max_features: int, peak_threshold: float, report: Report
) -> None:
    """Extract local features (SIFT) of all images that have none yet."""
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, threads()
    options.sift.max_num_features, options.sift.peak_threshold = max_features, peak_threshold
    with pycolmap.Database.open(file) as database:
        done = {
            image.name for image in database.read_all_images() if database.exists_descriptors(image.image_id)
        }
    todo = [name for name in names if name not in done]
    at_once = threads()
    for start in range(0, len(todo), at_once):
        ready = len(names) - len(todo) + start
        report(ready / len(names), f"features of {ready} of {len(names)} images")
        with quiet():
            pycolmap.extract_features(
                file,
                root,
                todo[start : start + at_once],
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )


def pairs_to_match(file: Path, sources: Sequence[PhotoSource], config: SfmConfig) -> list[tuple[str, str]]:
    """Names of the images of each pair worth matching."""
    import pycolmap

    names = [name for source in sources for name in source.images]
    if len(names) <= config.all_pairs_up_to:
        return [(names[i], names[j]) for i, j in every_pair(len(names))]
    with pycolmap.Database.open(file) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        descriptors = [np.asarray(database.read_descriptors(ids[name]).data, np.uint8) for name in names]
    number = {name: index for index, name in enumerate(names)}
    sequences = [[number[name] for name in source.images] for source in sources if source.ordered]
    pairs = chosen_pairs(descriptors, sequences, config.overlap, config.look_alikes, config.seed)
    return [(names[i], names[j]) for i, j in pairs]


def match(file: Path, work: Path, pairs: Sequence[tuple[str, str]], seed: int, report: Report) -> None:
    """Match features of pairs and verify them by two-view geometry. Pairs of an earlier run are kept."""
    import pycolmap

    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, threads()
    geometry, listing = pycolmap.TwoViewGeometryOptions(), pycolmap.ImportedPairingOptions()
    # Most pairs do not overlap, and proving that takes the full number of trials; a pair that needs more is not worth them.
    geometry.ransac.max_num_trials = _MOST_TRIALS
    listing.match_list_path = work / "pairs.txt"
    geometry.ransac.random_seed = seed
    start, at_once = 0, _FIRST_PAIRS
    while start < len(pairs):
        report(start / len(pairs), f"{start} of {len(pairs)} pairs of images matched")
        chunk, began_s = pairs[start : start + at_once], time.monotonic()
        write_atomically(listing.match_list_path, "".join(f"{a} {b}\n" for a, b in chunk))
        with quiet():
            pycolmap.match_image_pairs(file, options, listing, geometry, pycolmap.Device.cpu)
        start += len(chunk)
        rate = len(chunk) / max(time.monotonic() - began_s, 1e-3)
        at_once = min(max(round(_CALL_S * rate), _FIRST_PAIRS), _MOST_PAIRS)
    report(1.0, f"{len(pairs)} of {len(pairs)} pairs of images matched")


def verified_matches(file: Path) -> list[tuple[Array, Array]]:
    """Matches that fit the geometry of their pair, as `calibration.only_turned.turned` takes them."""
    import pycolmap

    with pycolmap.Database.open(file) as stored:
        cameras = {each.camera_id: each for each in stored.read_all_cameras()}
        camera_of = {each.image_id: cameras[each.camera_id] for each in stored.read_all_images()}
        found: list[tuple[Array, Array]] = []
        keypoints: dict[int, Array] = {}
        for pair, geometry in zip(*stored.read_two_view_geometries(), strict=True):
            if len(geometry.inlier_matches) < _FEWEST_MATCHES:
                continue
            images = pycolmap.pair_id_to_image_pair(pair)
            for image in images:
                if image not in keypoints:
                    size = np.array([camera_of[image].width, camera_of[image].height])
                    keypoints[image] = (stored.read_keypoints(image)[:, :2] - size / 2) / size.max()
            one, other = (keypoints[image][geometry.inlier_matches[:, k]] for k, image in enumerate(images))
            found.append((one, other))
    return found
