"""Reads any scan: recognises its format and calls its reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from advnerf_core.data.scan_folder import SCANS, scan_of
from calibration.scans import colmap, euroc, llff, nerfstudio, polycam, record3d, tum
from calibration.scans.scan import Scan, ScanError, ScanOptions

# With the options that each takes; --most is of all.
READERS: dict[str, tuple[Callable[[Path, ScanOptions], Scan], tuple[str, ...]]] = {
    "Polycam": (polycam.read, polycam.OPTIONS),
    "Record3D": (record3d.read, record3d.OPTIONS),
    "EuRoC": (euroc.read, euroc.OPTIONS),
    "nerfstudio": (nerfstudio.read, nerfstudio.OPTIONS),
    "COLMAP": (colmap.read, colmap.OPTIONS),
    "LLFF": (llff.read, llff.OPTIONS),
    "TUM": (tum.read, tum.OPTIONS),
}
_OPTIONS = ("images", "model", "calibration")
_SHOWN = 6


def read_scan(path: Path, options: ScanOptions) -> tuple[str, Scan]:
    """Read a scan; the name of its format, and its content.

    Raises:
        ScanError: The format is unknown or does not take an option, or the scan cannot be used.
        AdvnerfError: A file of it cannot be read.
    """
    found = scan_of(path)
    if found is None:
        known = "; ".join(f"{each.name} ({each.shown_by})" for each in SCANS)
        raise ScanError(
            f"{path}: expected a scan of one of the formats {known}, got {_shown(path)}; give the folder that holds these files, or photographs and videos to advnerf scene from-images"
        )
    read, takes = READERS[found.name]
    unused = [f"--{name}" for name in _OPTIONS if name not in takes and getattr(options, name) is not None]
    if unused:
        known = " and ".join(f"--{name}" for name in takes) or "none of these options"
        raise ScanError(
            f"{path}: expected {known} for a scan of {found.name}, which has the rest itself, got {' and '.join(unused)}; leave it out"
        )
    return found.name, read(path, options)


def _shown(path: Path) -> str:
    if not path.is_dir():
        return "a file" if path.exists() else "nothing"
    there = sorted(each.name for each in path.iterdir())
    return ", ".join(there[:_SHOWN]) + (", ..." if len(there) > _SHOWN else "") or "an empty folder"
