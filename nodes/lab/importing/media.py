"""Converts videos and folders of photographs to one folder of upright images, by camera."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.data import image_bytes, image_files, video
from advnerf_core.data.errors import DatasetError
from advnerf_core.data.keyframes import MOVEMENT
from advnerf_core.data.scan_folder import from_scan_advice
from advnerf_core.files import natural_order, write_atomically
from calibration.photo_model import PhotoSource
from nodes.lab.importing.errors import ImportRecordingError
from nodes.runtime.progress import Report

IMAGES = "images"
_SUFFIXES = (*image_files.SUFFIXES, *image_files.HEIF_SUFFIXES)


@dataclass(frozen=True)
class MediaConfig:
    """Settings for the conversion of media to images.

    Attributes:
        most: Largest number of images of each video or folder.
        one_camera: Whether all images are from one camera with one focal length.
    """

    most: int = 300
    one_camera: bool = False


def gather(media: Sequence[Path], output: Path, config: MediaConfig, report: Report) -> list[PhotoSource]:
    """Fill ``output/images`` from videos and folders of photographs. Finished parts of an earlier run are kept.

    Args:
        media: Video files, folders of photographs, or single photographs. The single ones count as one folder.

    Returns:
        One source for each video or folder, with paths relative to ``output``.
    """
    singles = [path for path in media if path.is_file() and _is_photograph(path)]
    entries: list[tuple[str, list[Path], bool]] = [("photos", singles, False)] if singles else []
    for path in media:
        if path in singles:
            continue
        if path.is_dir():
            entries.append((path.resolve().name, photographs_in(path), False))
        elif advice := from_scan_advice(path, ""):
            raise ImportRecordingError(f"expected a video or a folder of photographs, got {path}; {advice}")
        elif path.is_file():
            entries.append((path.stem, [path], True))
        else:
            raise ImportRecordingError(
                f"expected a video or a folder of photographs at {path}, found none; correct the path"
            )
    sources, names = [], set[str]()
    for index, (label, files, is_video) in enumerate(entries):
        name = _unique(label, names)
        folder = output / IMAGES / name
        progress = _part_of(report, index, len(entries))
        if is_video:
            kept = video.keep_keyframes(files[0], folder, MOVEMENT, config.most, progress)
        else:
            kept = _copy_photographs(video.thinned(files, config.most), folder, progress)
        images = tuple(path.relative_to(output).as_posix() for path in kept)
        sources.append(PhotoSource("camera" if config.one_camera else name, images, ordered=is_video))
    return sources


def _part_of(report: Report, index: int, parts: int) -> Report:
    def progress(fraction: float, text: str = "") -> None:
        report((index + fraction) / parts, text)

    return progress


def photographs_in(folder: Path) -> list[Path]:
    """Image files of a folder, sorted by name. Numbers in names are sorted by value. Files of other kinds are reported."""
    files, others = list[Path](), Counter[str]()
    for path in folder.iterdir():
        if path.is_file() and _is_photograph(path):
            files.append(path)
        elif path.is_file() and not path.name.startswith("."):
            others[path.suffix.lower() or "(no suffix)"] += 1
    if not files:
        advice = from_scan_advice(folder, "give the folder that holds them")
        raise ImportRecordingError(
            f"expected photographs ({', '.join(_SUFFIXES)}) in {folder}, got none; {advice}"
        )
    if others:
        kinds = ", ".join(f"{count} {suffix}" for suffix, count in sorted(others.items()))
        print(f"{folder}: {len(files)} photographs; left out, as they are of other kinds: {kinds}")
    return sorted(files, key=lambda path: natural_order(path.name))


def _is_photograph(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES


def _unique(label: str, taken: set[str]) -> str:
    # Spaces would break the list of pairs for COLMAP.
    base = re.sub(r"[^A-Za-z0-9_-]+", "_", label).strip("_") or "camera"
    name, number = base, 2
    while name in taken:
        name, number = f"{base}_{number}", number + 1
    taken.add(name)
    return name


def _copy_photographs(files: Sequence[Path], folder: Path, report: Report) -> list[Path]:
    """Copy all readable photographs; the others are left out and reported."""
    folder.mkdir(parents=True, exist_ok=True)
    copies, names, damaged = [], set[str](), []
    for file in files:
        if file.suffix.lower() in image_files.HEIF_SUFFIXES:
            image_files.heif_reader(file)  # without it most of a phone's pictures would be left out
    for index, file in enumerate(files):
        heif = file.suffix.lower() in image_files.HEIF_SUFFIXES
        copy = folder / f"{_unique(file.stem, names)}{'.jpg' if heif else file.suffix.lower()}"
        try:
            if not (copy.exists() and copy.stat().st_mtime_ns == file.stat().st_mtime_ns):
                _copy(file, copy)
            copies.append(copy)
        except DatasetError as error:
            damaged.append((file, error))
        report((index + 1) / len(files), f"{index + 1} of {len(files)} photographs copied")
    for stranger in set(folder.iterdir()) - set(copies):  # from an earlier run with other photographs
        stranger.unlink() if stranger.is_file() else shutil.rmtree(stranger)
    if damaged and not copies:
        raise ImportRecordingError(f"not one of {len(files)} photographs can be read; {damaged[0][1]}")
    if damaged:
        listed = ", ".join(str(file) for file, _ in damaged)
        print(
            f"left out, {len(damaged)} of {len(files)} photographs cannot be read: {listed}; {damaged[0][1]}"
        )
    return copies


def _copy(file: Path, copy: Path) -> None:
    """Make a complete, readable copy that is also upright for readers that ignore EXIF, and as old as the file, by which it is known."""
    data = image_files.read_bytes(file)
    turn = image_bytes.orientation(data)
    heif = image_bytes.is_heif(data)
    rgb, alpha = image_files.read_upright(file)  # raises an error that names a damaged file
    if heif or turn != 1:
        # Keep the camera and focal length in the EXIF data for structure from motion.
        exif = image_files.heif_exif(file, data) if heif else image_bytes.upright_exif(data)
        data = image_files.encoded(rgb, copy.suffix, alpha)
        data = data[:2] + exif + data[2:] if copy.suffix in (".jpg", ".jpeg") else data
    write_atomically(copy, data)
    now = file.stat()
    os.utime(copy, ns=(now.st_atime_ns, now.st_mtime_ns))
