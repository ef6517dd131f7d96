"""Recognises folders and files of scanning software, so that an error can name the command that reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

DATA_SET = "nerfstudio"  # the format of our own data sets
_COLMAP_FILES = ("cameras", "images", "points3D")
_TRAJECTORY_COLUMNS = 8  # timestamp tx ty tz qx qy qz qw
# Texts beside a trajectory are few; a folder with more is something else.
_MOST_TEXTS, _MOST_LINES = 50, 100


@dataclass(frozen=True)
class ScanFolder:
    """A format of posed images.

    Attributes:
        name: Short name.
        shown_by: What a folder of this format holds, for people.
        recognises: Whether a path has this format; looks at names and first lines only.
    """

    name: str
    shown_by: str
    recognises: Callable[[Path], bool]


def scan_of(path: Path) -> ScanFolder | None:
    """The format of a folder or file; None if it is of no known one. The most specific format comes first."""
    return next((each for each in SCANS if each.recognises(path)), None)


def from_scan_advice(folder: Path, otherwise: str) -> str:
    """Advice for an error about a folder without the expected files: the import, if it is a scan.

    Args:
        otherwise: The advice if it is no scan.
    """
    found = scan_of(folder)
    if found is None:
        return otherwise
    return f"it is of the format {found.name}, so run: advnerf scene from-scan {folder} -o NEW_FOLDER"


def model_suffix(folder: Path) -> str | None:
    """``.bin`` or ``.txt`` for a COLMAP model, binary first as in COLMAP; None if the folder has none."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in _COLMAP_FILES):
            return suffix
    return None


def colmap_models(folder: Path) -> Path | None:
    """The COLMAP model, or the folder of models, that belongs to a folder; None if it has none."""
    for models in (folder, folder / "sparse", folder / "colmap" / "sparse"):
        inside = models.iterdir() if models.is_dir() else ()
        if model_suffix(models) or any(model_suffix(each) for each in inside):
            return models
    return None


def record3d_source(path: Path) -> Path | None:
    """The ``.r3d`` archive, or the folder of an unpacked one; None if there is neither, or several archives."""
    if path.is_file():
        return path if path.suffix.lower() == ".r3d" else None
    archives = list(islice(path.glob("*.r3d"), 2)) if path.is_dir() else []
    if len(archives) == 1:
        return archives[0]
    unpacked = any((path / name).is_file() for name in ("metadata", "metadata.json"))
    return path if unpacked and any((path / name).is_dir() for name in ("rgbd", "rgb")) else None


def euroc_root(path: Path) -> Path | None:
    """The folder of the sensors (``mav0``) of a EuRoC recording; None if there is none."""
    roots = (path, path / "mav0")
    return next((each for each in roots if any(each.glob("cam*/data.csv"))), None)


def trajectories(folder: Path) -> list[Path]:
    """Text files of a folder that hold a trajectory in TUM's format, ``groundtruth.txt`` first."""
    texts = sorted(islice(folder.glob("*.txt"), _MOST_TEXTS)) if folder.is_dir() else []
    found = [each for each in texts if _holds_trajectory(each)]
    return sorted(found, key=lambda each: (each.name != "groundtruth.txt", each.name))


def _holds_trajectory(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            lines = [line.strip() for line in islice(stream, _MOST_LINES)]
    except OSError:
        return False
    first = next((line for line in lines if line and not line.startswith(b"#")), b"")
    return len(first.split()) == _TRAJECTORY_COLUMNS


def _is_polycam(path: Path) -> bool:
    cameras = (path / "keyframes" / name for name in ("corrected_cameras", "cameras"))
    return any(each.is_dir() for each in cameras)


def _has_transforms(path: Path) -> bool:
    if path.suffix == ".json":
        return path.is_file()
    return any((path / name).is_file() for name in _transforms_names())


def _transforms_names() -> Iterator[str]:
    yield "transforms.json"
    yield from (f"transforms_{split}.json" for split in ("train", "val", "test"))


# Polycam's and COLMAP's own files say more than what other tools wrote beside them.
SCANS = (
    ScanFolder("Polycam", "keyframes/cameras/*.json", _is_polycam),
    ScanFolder(
        "Record3D",
        "NAME.r3d, or metadata beside rgbd",
        lambda path: record3d_source(path) is not None,
    ),
    ScanFolder("EuRoC", "mav0/cam0/data.csv", lambda path: path.is_dir() and euroc_root(path) is not None),
    ScanFolder(DATA_SET, "transforms.json", _has_transforms),
    ScanFolder("COLMAP", "sparse/0 beside images", lambda path: colmap_models(path) is not None),
    ScanFolder("LLFF", "poses_bounds.npy", lambda path: (path / "poses_bounds.npy").is_file()),
    ScanFolder("TUM", "groundtruth.txt beside rgb", lambda path: bool(trajectories(path))),
)
