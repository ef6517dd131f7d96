"""Builds a data set in a separate folder and moves it when it is complete, so that a failed import leaves no incomplete data set."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import IMAGES
from nodes.runtime.locks import HeldError, hold

TRANSFORMS, REPORT_FILE, COLMAP, MASKS = "transforms.json", "import.json", "colmap", "masks"
TRANSFORMS_PHONE, TRANSFORMS_CAR = "transforms_phone.json", "transforms_car.json"
ALL_TRANSFORMS = (TRANSFORMS, TRANSFORMS_PHONE, TRANSFORMS_CAR)
# In the order in which they are moved. After the last one, the folder is a data set.
_ENTRIES = (IMAGES, MASKS, COLMAP, REPORT_FILE, TRANSFORMS_PHONE, TRANSFORMS_CAR, TRANSFORMS)
_CLAIM, _LOCK = ".made_by_advnerf", ".lock"

Built = TypeVar("Built")


def work_folder(output: Path) -> Path:
    """Folder in which a data set is built: its name with ``.part`` appended."""
    output = output.resolve()
    return output.with_name(f"{output.name}.part")


def build_beside(
    output: Path, inputs: Sequence[Path | None], build: Callable[[Path], Built], resumes: bool = True
) -> Built:
    """Build a data set in the work folder and move it to its destination.

    A stopped import keeps its work folder if structure from motion or the selection of video frames had started, and the next import
    resumes there. Other files in ``output`` are not touched. An earlier data set there is kept until the new one is complete; it is said if they differ.

    Args:
        inputs: Input files and folders, which must not be what is replaced, nor inside it; None is skipped.
        resumes: Whether a failed or stopped import may keep its work folder. Otherwise it is always removed.

    Raises:
        ImportRecordingError: A folder has other files, another import is running, or ``build`` failed and its work is kept.
    """
    work = work_folder(output)
    _require_ours(output, work, inputs)
    began_here = not work.exists()
    work.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(work / _LOCK)
    except HeldError as error:
        raise ImportRecordingError(
            f"expected no other import into {output}, but process {error.owner} is using {work}; wait until it ends, or stop it"
        ) from None
    with lock:
        try:
            if began_here and resumes:
                _take_over(output, work)
            write_atomically(
                work / IMAGES / _CLAIM,
                "Images in this folder are copies; an import replaces and removes them.\n",
            )
            built = build(work)
        except BaseException as error:
            if not (resumes and _is_worth_keeping(work)):
                shutil.rmtree(work)
            elif isinstance(error, AdvnerfError):
                raise ImportRecordingError(
                    f"{error}. Finished work is kept in {work}: run the same command to resume"
                ) from error
            raise
        changed = _content(output / TRANSFORMS) not in (None, _content(work / TRANSFORMS))
        _move(work, output)
    if changed:
        print(
            f"{output}: replaced an earlier data set; what was learned from that one does not fit: learn it again"
        )
    return built


def _content(file: Path) -> bytes | None:
    return file.read_bytes() if file.is_file() else None


def _require_ours(output: Path, work: Path, inputs: Sequence[Path | None]) -> None:
    """Check that the images in a folder are from an earlier import, because they are replaced. A user's photographs are never touched."""
    for own in (*(output / name for name in _ENTRIES), work):
        inside = [path for path in inputs if path and path.resolve().is_relative_to(own.resolve())]
        if inside:
            raise ImportRecordingError(
                f"expected inputs outside {own}, where the data set stores its copies; got {inside[0]}. Give another --output"
            )
    # All of these are replaced.
    there = [output / name for name in _ENTRIES if _holds_files(output / name)]
    if there and not (output / IMAGES / _CLAIM).exists():
        raise ImportRecordingError(
            f"expected a new folder or one of an earlier import, but {output} has other files: {there[0].name}; give another --output"
        )
    if (
        work.exists()
        and any(work.iterdir())
        and not ((work / IMAGES / _CLAIM).exists() or (work / _LOCK).exists())
    ):
        raise ImportRecordingError(
            f"expected to build the data set in {work}, but that folder has other files; rename it, or give another --output"
        )


def _holds_files(path: Path) -> bool:
    return any(path.iterdir()) if path.is_dir() else path.exists()


def _take_over(output: Path, work: Path) -> None:
    """Reuse the images and the structure from motion of an earlier import, which may be most of the work."""
    if not (output / IMAGES / _CLAIM).exists():
        return
    shutil.copytree(output / IMAGES, work / IMAGES, copy_function=_link_or_copy)
    if (output / COLMAP).exists():
        # Copied instead of linked, because COLMAP writes to its database.
        shutil.copytree(output / COLMAP, work / COLMAP)


def _link_or_copy(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without links
        shutil.copy2(source, target)


def _is_worth_keeping(work: Path) -> bool:
    # Photographs can be copied again in seconds. Features and video frames take longer.
    return (work / COLMAP).exists() or any((work / IMAGES).glob("*/keyframes.json"))


def _move(work: Path, output: Path) -> None:
    """Move a finished data set to its destination. If this is interrupted, the folder has no ``transforms.json``."""
    output.mkdir(parents=True, exist_ok=True)
    for name in reversed(_ENTRIES):
        if (output / name).is_dir():
            shutil.rmtree(output / name)
        else:
            (output / name).unlink(missing_ok=True)
    for name in _ENTRIES:
        if (work / name).exists():
            shutil.move(work / name, output / name)
    shutil.rmtree(work)
