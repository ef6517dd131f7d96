"""What COLMAP keeps of photographs: cameras, features, matches, in one file that a stopped run goes on with."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from advnerf_core.scene.image_files import image_size
from advnerf_core.scene.lens import Lens
from calibration.photo_pairs import chosen_pairs, every_pair

if TYPE_CHECKING:
    from calibration.structure_from_motion import SfmConfig, Source

Progress = Callable[[float, str], None]
_FILE, _KEY = "database.db", "inputs.json"
_IMAGES_AT_ONCE, _PAIRS_AT_ONCE, _MOST_TRIALS = 16, 400, 2000
# Where the focal length is unknown: a phone's main camera and most others lie within a factor of two of this many image widths.
_GUESSED_FOCAL_LENGTH = 0.9


def threads() -> int:
    """As many as this process may use."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep COLMAP's log to its errors: it writes several lines for each image."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def open_work(root: Path, work: Path, sources: Sequence[Source], config: Mapping[str, Any]) -> Path:
    """The database in the work folder: that of a stopped run with the same inputs, else a new one with all cameras and images."""
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


def _key(root: Path, sources: Sequence[Source], config: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for source in sources:
        digest.update(repr((source.camera_id, source.ordered, source.pinhole, source.lens)).encode())
        for name in source.images:
            digest.update(name.encode() + b"\0" + hashlib.sha256((root / name).read_bytes()).digest())
    return json.dumps({"config": dict(config), "images": digest.hexdigest()}, sort_keys=True)


def _create(file: Path, root: Path, sources: Sequence[Source]) -> None:
    """One camera for each source, and for each size of its images: a phone held upright counts as another camera."""
    import pycolmap

    pycolmap.Database.open(file).close()
    for source in sources:
        sizes: dict[tuple[int, int], list[str]] = {}
        for name in source.images:
            sizes.setdefault(image_size(root / name), []).append(name)
        for size, names in sizes.items():
            options = pycolmap.ImageReaderOptions()
            options.camera_model = "OPENCV"
            if (params := _params(source, size)) is not None:
                options.camera_params = ",".join(f"{value:.17g}" for value in params)
            options.default_focal_length_factor = _GUESSED_FOCAL_LENGTH
            with quiet():
                pycolmap.import_images(file, root, pycolmap.CameraMode.SINGLE, names, options)


def _params(source: Source, size: tuple[int, int]) -> list[float] | None:
    if source.pinhole is None:
        return None
    p = source.pinhole.resized(*size)
    return [p.fx, p.fy, p.cx, p.cy, *source.lens.coefficients[:4]]


def held_cameras(file: Path, sources: Sequence[Source]) -> set[int]:
    """COLMAP's numbers of the cameras whose intrinsics are known."""
    import pycolmap

    known = {name for source in sources if source.pinhole is not None for name in source.images}
    with pycolmap.Database.open(file) as database:
        return {image.camera_id for image in database.read_all_images() if image.name in known}


def extract_features(
    file: Path, root: Path, names: Sequence[str], max_features: int, peak_threshold: float, report: Progress
) -> None:
    """Local features (SIFT) of all images that have none yet."""
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, threads()
    options.sift.max_num_features, options.sift.peak_threshold = max_features, peak_threshold
    with pycolmap.Database.open(file) as database:
        done = {image.name for image in database.read_all_images() if database.exists_descriptors(image.image_id)}
    todo = [name for name in names if name not in done]
    for start in range(0, len(todo), _IMAGES_AT_ONCE):
        report((len(names) - len(todo) + start) / len(names), f"features of {len(names)} images")
        with quiet():
            pycolmap.extract_features(
                file,
                root,
                todo[start : start + _IMAGES_AT_ONCE],
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )


def pairs_to_match(file: Path, sources: Sequence[Source], config: SfmConfig) -> list[tuple[str, str]]:
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


def match(file: Path, work: Path, pairs: Sequence[tuple[str, str]], report: Progress) -> None:
    """Match features of pairs and verify them by two-view geometry; pairs of an earlier run are left as they are."""
    import pycolmap

    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, threads()
    geometry, listing = pycolmap.TwoViewGeometryOptions(), pycolmap.ImportedPairingOptions()
    # Most pairs do not overlap, and proving that takes all the trials there are; a pair that needs more is not worth them.
    geometry.ransac.max_num_trials = _MOST_TRIALS
    listing.match_list_path = work / "pairs.txt"
    for start in range(0, len(pairs), _PAIRS_AT_ONCE):
        report(start / len(pairs), f"{start} of {len(pairs)} pairs of images matched")
        chunk = pairs[start : start + _PAIRS_AT_ONCE]
        write_atomically(work / "pairs.txt", "".join(f"{a} {b}\n" for a, b in chunk))
        with quiet():
            pycolmap.match_image_pairs(file, options, listing, geometry, pycolmap.Device.cpu)


def intrinsics(camera: Any) -> tuple[Pinhole, Lens]:
    """Our intrinsics of a COLMAP camera with the model OPENCV; both count pixel centres from +0.5."""
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(value) for value in camera.params)
    return Pinhole(int(camera.width), int(camera.height), fx, fy, cx, cy), Lens((k1, k2, p1, p2, 0.0))
